"""Whence the sensor's motion is known, and what KISS-ICP makes of scans where nothing says it."""

from __future__ import annotations

import sys
from functools import partial
from itertools import chain, combinations
from pathlib import Path

import numpy as np
import pytest
from tracking_samples import pose

from lidar_perception.data.frame import POSES, Frame, Recording
from lidar_perception.simulation.drive import simulate_drive
from lidar_perception.tracking import drive_tracker, ego
from lidar_perception.tracking.drive_tracker import LOOKED_AT, ego_of
from lidar_perception.tracking.ego import (
    NO_SOURCE,
    SOURCES,
    Odometry,
    best_source,
    recorded_poses,
    recorded_source,
)
from lidar_perception.tracking.params import EGO_SOURCES, RECORDED_EGO
from lidar_perception.types import InputError

SETS = [{*chosen} for chosen in chain.from_iterable(
    combinations(SOURCES, count) for count in range(len(SOURCES) + 1))]


@pytest.mark.parametrize("there", SETS, ids=lambda names: "+".join(sorted(names)) or "nothing")
def test_the_best_source_that_is_there_is_taken_and_more_sources_never_give_a_worse_one(there):
    def rank(name):
        return (*SOURCES, NO_SOURCE).index(name)
    best = best_source("auto", there)
    assert rank(best) == min(map(rank, there), default=rank(NO_SOURCE))
    for name in SOURCES:
        assert best_source(name, there) == (name if name in there else NO_SOURCE)
        assert rank(best_source("auto", {*there, name})) == min(rank(best), rank(name))
    assert best_source(NO_SOURCE, there) == NO_SOURCE


def test_every_source_that_can_be_asked_for_is_known():
    assert {*EGO_SOURCES, *RECORDED_EGO} == {"auto", *SOURCES, NO_SOURCE}


@pytest.mark.parametrize("installed", [True, False])
def test_recorded_poses_come_before_the_scans_and_what_is_asked_for_is_not_replaced(monkeypatch,
                                                                                   installed):
    monkeypatch.setattr(ego, "has_odometry", lambda: installed)
    assert recorded_source(True) == "recording"
    assert recorded_source(False) == ("kiss_icp" if installed else NO_SOURCE)
    frames = [Frame("0", 0, lambda: None, pose=lambda: np.eye(4))]
    for poses in True, False:
        recording = Recording(Path("drive"), "", frames, frozenset({POSES} if poses else ()))
        for wanted in RECORDED_EGO:
            assert ego_of(recording, wanted) == recorded_source(poses, wanted)
            assert wanted == "auto" or recorded_source(poses, wanted) == wanted


@pytest.mark.parametrize("installed", [True, False])
@pytest.mark.parametrize("first", [0, LOOKED_AT - 1, LOOKED_AT, 200])
def test_poses_that_the_first_frames_have_not_give_way_to_the_scans(monkeypatch, installed, first):
    """And no frame after these is read to see it: a bag can be an hour long."""
    for module in ego, drive_tracker:
        monkeypatch.setattr(module, "has_odometry", lambda: installed)
    read = []

    def pose_of(number):
        read.append(number)
        if number == 3:
            raise InputError("it cannot be read")
        return np.eye(4) if number >= first else np.full((4, 4), np.nan)

    frames = [Frame(str(i), i, lambda: None, pose=partial(pose_of, i)) for i in range(200)]
    recording = Recording(Path("drive"), "", frames, frozenset({POSES}))
    assert ego_of(recording) == ("kiss_icp" if installed and first >= LOOKED_AT else "recording")
    assert ego_of(recording, "recording") == "recording"
    assert read == [*range(min(first + 1, LOOKED_AT))] * installed


def test_without_the_extra_it_is_said_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "kiss_icp.config.parser", None)
    with pytest.raises(InputError, match=r"lidar_perception\[odometry\]"):
        recorded_poses("kiss_icp")


@pytest.fixture(scope="module")
def drive():
    pytest.importorskip("kiss_icp", reason="needs kiss-icp, the extra [odometry]")
    return [(scan.frame.xyz, scan.pose) for scan in simulate_drive(5, 6)]


def test_odometry_says_how_a_simulated_drive_went_and_always_the_same(drive):
    first, again = Odometry(), Odometry()
    for xyz, at in drive:
        found = first(xyz)
        np.testing.assert_array_equal(again(xyz), found)
        step = np.linalg.inv(drive[0][1]) @ at
        assert np.linalg.norm(found[:3, 3] - step[:3, 3]) < 0.25
        assert np.abs(found[:3, :3] - step[:3, :3]).max() < 5e-3


def test_few_points_are_registered_all_the_same(drive):
    """As in a small room, where a coarse grid would leave next to nothing."""
    xyz = drive[0][0]
    near = xyz[np.linalg.norm(xyz[:, :2], axis=1) < 12]
    odometry = Odometry()
    for i in range(5):
        at = pose(0.1 * i, 0.02 * i, 0.01 * i)
        seen = near @ at[:3, :3] - at[:3, 3] @ at[:3, :3]
        found = odometry(seen.astype(np.float32))
    np.testing.assert_allclose(found, at, atol=0.05)

"""Choice of the source of the sensor's motion, and odometry by KISS-ICP."""

from __future__ import annotations

import sys
from functools import partial
from itertools import chain, combinations
from pathlib import Path

import numpy as np
import pytest
from tracking_samples import make_flat_pose

from lidar_perception.data.frame import POSES, Frame, Recording
from lidar_perception.simulation.drive import simulate_drive
from lidar_perception.tracking import drive_tracker, ego
from lidar_perception.tracking.drive_tracker import MAX_POSE_CHECKS, choose_ego_source
from lidar_perception.tracking.ego import (
    NO_SOURCE,
    SOURCES,
    Odometry,
    choose_recorded_source,
    choose_source,
    make_pose_reader,
)
from lidar_perception.tracking.params import EGO_SOURCES, RECORDED_EGO
from lidar_perception.types import InputError

SETS = [{*chosen} for chosen in chain.from_iterable(combinations(SOURCES, count) for count in range(len(SOURCES) + 1))]


@pytest.mark.parametrize("available", SETS, ids=lambda names: "+".join(sorted(names)) or "nothing")
def test_best_available_source_is_chosen(available):
    def rank(name):
        return (*SOURCES, NO_SOURCE).index(name)

    best = choose_source("auto", available)
    assert rank(best) == min(map(rank, available), default=rank(NO_SOURCE))
    for name in SOURCES:
        assert choose_source(name, available) == (name if name in available else NO_SOURCE)
        assert rank(choose_source("auto", {*available, name})) == min(rank(best), rank(name))
    assert choose_source(NO_SOURCE, available) == NO_SOURCE


def test_source_options_are_the_known_sources():
    assert {*EGO_SOURCES, *RECORDED_EGO} == {"auto", *SOURCES, NO_SOURCE}


@pytest.mark.parametrize("installed", [True, False])
def test_recorded_poses_come_before_kiss_icp(monkeypatch, installed):
    monkeypatch.setattr(ego, "has_odometry", lambda: installed)
    assert choose_recorded_source(True) == "recording"
    assert choose_recorded_source(False) == ("kiss_icp" if installed else NO_SOURCE)
    frames = [Frame("0", 0, lambda: None, pose=lambda: np.eye(4))]
    for poses in True, False:
        recording = Recording(Path("drive"), "", frames, frozenset({POSES} if poses else ()))
        for source in RECORDED_EGO:
            expected = choose_recorded_source(poses) if source == "auto" else source
            assert choose_ego_source(recording, source) == expected


@pytest.mark.parametrize("installed", [True, False])
@pytest.mark.parametrize("first", [0, MAX_POSE_CHECKS - 1, MAX_POSE_CHECKS, 200])
def test_kiss_icp_replaces_poses_missing_at_the_start(monkeypatch, installed, first):
    """The choice reads the first frames only, because a bag can be an hour long."""
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
    assert choose_ego_source(recording) == ("kiss_icp" if installed and first >= MAX_POSE_CHECKS else "recording")
    assert choose_ego_source(recording, "recording") == "recording"
    assert read == [*range(min(first + 1, MAX_POSE_CHECKS))] * installed


def test_missing_kiss_icp_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "kiss_icp.config.parser", None)
    with pytest.raises(InputError, match=r"lidar_perception\[odometry\]"):
        make_pose_reader("kiss_icp")


@pytest.fixture(scope="module")
def drive():
    pytest.importorskip("kiss_icp", reason="needs kiss-icp, the extra [odometry]")
    return [(scan.frame.xyz, scan.pose) for scan in simulate_drive(5, 6)]


def test_odometry_of_simulated_drive_is_repeatable(drive):
    first, second = Odometry(), Odometry()
    for xyz, at in drive:
        found = first(xyz)
        np.testing.assert_array_equal(second(xyz), found)
        step = np.linalg.inv(drive[0][1]) @ at
        assert np.linalg.norm(found[:3, 3] - step[:3, 3]) < 0.25
        assert np.abs(found[:3, :3] - step[:3, :3]).max() < 5e-3


def test_odometry_registers_small_scans(drive):
    """A coarse grid leaves too few points in a small room."""
    xyz = drive[0][0]
    near = xyz[np.linalg.norm(xyz[:, :2], axis=1) < 12]
    odometry = Odometry()
    for i in range(5):
        at = make_flat_pose(0.1 * i, 0.02 * i, 0.01 * i)
        sensor_points = near @ at[:3, :3] - at[:3, 3] @ at[:3, :3]
        found = odometry(sensor_points.astype(np.float32))
    np.testing.assert_allclose(found, at, atol=0.05)

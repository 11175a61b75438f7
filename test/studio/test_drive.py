"""Tests of drives, the cache of scans, and the size and heading of fitted boxes."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from lidar_perception.data.frame import Recording
from lidar_perception.geometry import box_corners
from lidar_perception.simulation.recording import simulate_frames
from lidar_perception.types import InputError
from lidar_studio.drive import Scan, ScanCache, select_drive
from lidar_studio.snap import align_heading, fit_clicked_box, resize_box


def test_scan_cache_is_bounded_and_computes_each_scan_once():
    made_frames = []

    def make_scan(i):
        made_frames.append(i)
        return Scan(
            np.zeros((1000, 3), np.float32), np.zeros(1000, np.uint8), np.zeros(1000, bool), np.zeros(1000, np.int32)
        )

    load_scan = ScanCache(make_scan, max_bytes=5 * make_scan(0).nbytes)
    made_frames.clear()
    threads = [threading.Thread(target=load_scan, args=(3,)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert made_frames == [3]
    for i in range(1000):
        load_scan(i)
        assert sum(s.nbytes for s in load_scan._scans.values()) == load_scan._size <= 5 * make_scan(0).nbytes
    assert len(load_scan._locks) <= 6


def test_recording_of_several_drives_requires_a_sequence():
    frames = [*simulate_frames(119, 2, frames_per_drive=1)]
    recording = Recording(Path("two"), "simulated", frames)
    with pytest.raises(InputError, match="--sequence"):
        select_drive(recording)
    assert [f.sequence for f in select_drive(recording, "0001").frames] == ["0001"]
    with pytest.raises(InputError, match="no drive 7"):
        select_drive(recording, "7")


def test_resized_box_keeps_the_visible_corner():
    rng = np.random.default_rng(0)
    for _ in range(50):
        box = np.array([*rng.uniform(8, 20, 2) * rng.choice([-1, 1], 2), 0, *rng.uniform(1, 4, 3), rng.uniform(-3, 3)])
        resized_box = resize_box(box, rng.uniform(1, 4, 3))
        corners, new_corners = (box_corners(b[None])[0][:, :2] for b in (box, resized_box))
        nearest = int(np.hypot(*corners.T).argmin())
        sensor_x = np.array([np.cos(box[6]), np.sin(box[6])]) @ -box[:2]
        sensor_y = np.array([-np.sin(box[6]), np.cos(box[6])]) @ -box[:2]
        if abs(sensor_x) > box[3] / 2 and abs(sensor_y) > box[4] / 2:
            assert np.allclose(corners[nearest], new_corners[nearest])
        assert resized_box[2] - resized_box[5] / 2 == pytest.approx(box[2] - box[5] / 2)
        assert resize_box(resized_box, box[3:6]) == pytest.approx(box) or abs(sensor_x) <= 4


def test_box_with_aligned_heading_covers_the_same_volume():
    box = np.array([1.0, 2, 3, 4, 2, 1, 0.3])
    for quarter_turns in range(-4, 5):
        aligned_box = align_heading(box, 0.3 + quarter_turns * np.pi / 2)
        assert align_heading(aligned_box, 0.35) == pytest.approx(box)


def test_click_near_a_wall_fits_a_box_to_its_nearest_part():
    y, z = np.meshgrid(np.arange(-4, 4, 0.1), np.arange(-1.5, 0.5, 0.1))
    xyz = np.stack([np.full(y.size, 9.0), y.ravel(), z.ravel()], 1).astype(np.float32)
    scan = Scan(xyz, np.zeros(len(xyz), np.uint8), np.zeros(len(xyz), bool), np.ones(len(xyz), np.int32))
    box = fit_clicked_box(scan, np.array([8.0, 0.0, -1.0]), "Pedestrian")
    assert abs(box[0] - 9.0) < 0.5 and abs(box[1]) < 0.3 and box[3] < 1.5

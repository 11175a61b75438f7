"""Drives to label, the cache of scans, and sizes and headings of boxes."""

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


def test_scan_cache_is_bounded_and_loads_each_scan_once():
    made = []

    def make(i):
        made.append(i)
        return Scan(
            np.zeros((1000, 3), np.float32), np.zeros(1000, np.uint8), np.zeros(1000, bool), np.zeros(1000, np.int32)
        )

    clouds = ScanCache(make, limit=5 * make(0).nbytes)
    made.clear()
    threads = [threading.Thread(target=clouds, args=(3,)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert made == [3]
    for i in range(1000):
        clouds(i)
        assert sum(s.nbytes for s in clouds._scans.values()) == clouds._size <= 5 * make(0).nbytes
    assert len(clouds._locks) <= 6


def test_recording_of_several_drives_needs_a_sequence():
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
        other = resize_box(box, rng.uniform(1, 4, 3))
        corners, after = (box_corners(b[None])[0][:, :2] for b in (box, other))
        nearest = int(np.hypot(*corners.T).argmin())
        seen = np.array([np.cos(box[6]), np.sin(box[6])]) @ -box[:2]
        if abs(seen) > box[3] / 2 and abs(np.array([-np.sin(box[6]), np.cos(box[6])]) @ -box[:2]) > box[4] / 2:
            assert np.allclose(corners[nearest], after[nearest])
        assert other[2] - other[5] / 2 == pytest.approx(box[2] - box[5] / 2)
        assert resize_box(other, box[3:6]) == pytest.approx(box) or abs(seen) <= 4


def test_aligned_heading_is_the_same_box():
    box = np.array([1.0, 2, 3, 4, 2, 1, 0.3])
    for turn in range(-4, 5):
        again = align_heading(align_heading(box, 0.3 + turn * np.pi / 2), 0.35)
        assert again == pytest.approx(box)


def test_click_next_to_a_wall_boxes_its_nearest_part():
    y, z = np.meshgrid(np.arange(-4, 4, 0.1), np.arange(-1.5, 0.5, 0.1))
    xyz = np.stack([np.full(y.size, 9.0), y.ravel(), z.ravel()], 1).astype(np.float32)
    scan = Scan(xyz, np.zeros(len(xyz), np.uint8), np.zeros(len(xyz), bool), np.ones(len(xyz), np.int32))
    box = fit_clicked_box(scan, np.array([8.0, 0.0, -1.0]), "Pedestrian")
    assert abs(box[0] - 9.0) < 0.5 and abs(box[1]) < 0.3 and box[3] < 1.5

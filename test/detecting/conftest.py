"""Fixtures for tests of `detect`."""

from __future__ import annotations

import detect_samples
import pytest
from detect_samples import NAME, MadeDetector
from kitti_samples import write_tracking_folder
from samples import make_walker_label, write_object_folder

from lidar_perception.detectors import open as opening
from lidar_perception.detectors.open import LOAD


@pytest.fixture(autouse=True)
def stand_in_calls(monkeypatch):
    """Register MadeDetector under NAME, and return the list of its calls."""
    monkeypatch.setitem(LOAD, NAME, "")
    monkeypatch.setattr(opening, "_find_loader", lambda kind: detect_samples.load_made_detector)
    monkeypatch.setattr(MadeDetector, "calls", [])
    return MadeDetector.calls


@pytest.fixture
def kitti(tmp_path):
    """Four labelled frames."""
    return write_object_folder(tmp_path / "kitti", make_walker_label() + "\n", 4)


@pytest.fixture
def drives(tmp_path):
    """Two sequences, of three and of two frames."""
    return write_tracking_folder(tmp_path / "drives")

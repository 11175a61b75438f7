"""Recordings for tests of the command line."""

import pytest
from cli_samples import run
from samples import object_folder, walker_label


@pytest.fixture(scope="module")
def kitti(tmp_path_factory):
    """Folder in KITTI's object layout with two scans of a pedestrian."""
    return object_folder(tmp_path_factory.mktemp("kitti"), walker_label() + "\n")


@pytest.fixture(scope="module")
def bag(kitti, tmp_path_factory):
    path = tmp_path_factory.mktemp("bags") / "drive"
    run("convert", kitti, "--out", path)
    return path

"""Recordings for tests of the command line."""

import pytest
from cli_samples import run_command
from samples import make_walker_label, write_object_folder


@pytest.fixture(scope="module")
def kitti(tmp_path_factory):
    """Folder in KITTI's object layout with two scans of a pedestrian."""
    return write_object_folder(tmp_path_factory.mktemp("kitti"), make_walker_label() + "\n")


@pytest.fixture(scope="module")
def bag(kitti, tmp_path_factory):
    path = tmp_path_factory.mktemp("bags") / "drive"
    run_command("convert", kitti, "--out", path)
    return path

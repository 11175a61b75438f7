"""Settings of all tests, and shared fixtures: bags and data sets.

Fixtures for ROS are in the plugin lidar_perception.testing.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import sys
from multiprocessing import forkserver, resource_tracker
from pathlib import Path

import pytest
from hypothesis import settings

from lidar_perception.runs.memory import keep_freed_memory

pytest_plugins = ["lidar_perception.testing"]
os.environ.pop("COLUMNS", None)  # pytest-xdist sets 80 for its workers; some tests set their own
keep_freed_memory()  # as commands and nodes do

# No test measures time. --hypothesis-profile deep tries many more examples.
settings.register_profile("everyday", deadline=None, max_examples=40)
settings.register_profile("deep", deadline=None, max_examples=2000)
settings.load_profile("everyday")


def pytest_itemcollected(item):
    """Exclude tests of Hypothesis from coverage, which takes longer than the tests themselves."""
    function = getattr(item, "obj", None)  # a test of launch_testing has none
    if getattr(function, "is_hypothesis_test", False):
        item.add_marker("no_cover")


def pytest_collection_finish():
    """Initialize autograd before all tests, and exclude imported objects from garbage collection.

    Autograd counts the devices in its first backward pass. After an ONNX export, a CUDA build of torch would count
    a device that does not exist, and backward passes in forked processes would fail.
    """
    if (torch := sys.modules.get("torch")) is not None:
        torch.ones((), requires_grad=True).backward()
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """Apply no_cover to processes that a test starts, too.

    coverage wraps os._exit at each start. Unless it is restored, processes that are forked later save their data
    several times.
    """
    with pytest.MonkeyPatch.context() as patch:
        if item.get_closest_marker("no_cover"):
            patch.delenv("COVERAGE_PROCESS_CONFIG", raising=False)
            patch.setattr(os, "_exit", os._exit)
        return (yield)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish():
    """Stop the helper processes of multiprocessing, which would still write coverage files while
    these are combined."""
    for process in multiprocessing.active_children():
        process.kill()
        process.join()
    forkserver._forkserver._stop()
    resource_tracker._resource_tracker._stop()


@pytest.fixture(scope="session")
def data() -> Path:
    """Folder of real scans next to the checkout; the test is skipped without it."""
    from samples import DATA

    if not DATA.is_dir():
        pytest.skip("real data is not beside the checkout (../shared/data)")
    return DATA


@pytest.fixture
def keep_ego_detections(monkeypatch):
    """Keep detections of the ego vehicle, because networks with random weights detect objects there, too."""
    from lidar_perception.detectors import normalized_view

    monkeypatch.setattr(normalized_view, "drop_ego_vehicle", lambda detections, height: detections)


@pytest.fixture
def one_thread():
    """Use one thread of torch, because small networks are slower with more threads on busy cores."""
    import torch

    from lidar_perception.runs.threads import set_thread_count

    before = torch.get_num_threads()
    set_thread_count(1)
    yield
    set_thread_count(before)


@pytest.fixture(scope="module")
def one_thread_for_all():
    """Use one thread of torch in a whole module, for bitwise comparison of training runs."""
    import torch

    from lidar_perception.runs.threads import set_thread_count

    before = torch.get_num_threads()
    set_thread_count(1)
    yield
    set_thread_count(before)


@pytest.fixture(scope="session")
def streets():
    """Cache the simulated streets for the whole session."""
    from functools import cache

    from lidar_perception.simulation import drive

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drive, "_make_cached_scene", cache(drive._make_cached_scene.__wrapped__))
        yield


@pytest.fixture(scope="session")
def sample_bag(tmp_path_factory) -> Path:
    """Bag of bag_samples.scans(). Tests must copy it before they change it."""
    from bag_samples import scans

    from lidar_perception.data.to_bag import write_bag

    path = tmp_path_factory.mktemp("bags") / "drive"
    assert write_bag(path, scans()) == 3
    return path


@pytest.fixture
def tiny_size(monkeypatch):
    """The compact size of PointPillars has few channels and a coarse grid."""
    from lidar_perception.detectors.pointpillars import config

    monkeypatch.setitem(
        config.SIZES,
        "compact",
        dict(
            low=(0.0, -20.48, -3.0),
            high=(40.96, 20.48, 1.0),
            cell=0.64,
            pillar_channels=8,
            map_channels=(4, 8),
            block_channels=(8, 12, 16),
            block_layers=(1, 1, 1),
            deconv_channels=8,
            fpn_channels=8,
        ),
    )


@pytest.fixture
def tiny_sensor(monkeypatch):
    """Register the sensor of simulate_samples as a preset."""
    from simulate_samples import TINY

    from lidar_perception.simulation.sensor import SENSORS

    monkeypatch.setitem(SENSORS, "tiny", TINY)


@pytest.fixture(scope="session")
def simulated_data_sets(streets, tmp_path_factory) -> Path:
    """Folder with a simulated data set of five frames in each layout."""
    from simulate_samples import TINY, run_simulate

    from lidar_perception.simulation.dataset import LAYOUTS
    from lidar_perception.simulation.sensor import SENSORS

    root = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SENSORS, "tiny", TINY)
        for layout in LAYOUTS:
            assert run_simulate(root / layout, layout, 5, 1, "--streets-of", 2).exit_code == 0
    return root


@pytest.fixture(scope="session")
def crowd_recording(tmp_path_factory) -> Path:
    """KITTI folder with crowds of people."""
    from experiment_samples import COUNT
    from samples import write_crowd_folder

    return write_crowd_folder(tmp_path_factory.mktemp("kitti"), COUNT)


@pytest.fixture(scope="session")
def paper_run(crowd_recording, tmp_path_factory) -> Path:
    """Folder of a complete run of the paper's experiment on `crowds`; its printed output is in ../said."""
    from experiment_samples import run_reproduce
    from samples import write_file

    out = tmp_path_factory.mktemp("whole") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "160")
        write_file(out.parent / "said", run_reproduce("--data", crowd_recording, "--out", out, "--jobs", 1))
    return out


@pytest.fixture
def five_scans(tmp_path) -> Path:
    """KITTI folder of five scans."""
    from samples import write_object_folder

    return write_object_folder(tmp_path / "few", count=5)

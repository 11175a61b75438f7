"""Fixtures of more than one file: bags and data sets. Those of ROS are the package's own plugin."""

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

# No test measures time. --hypothesis-profile deep looks where the everyday run seldom comes.
settings.register_profile("everyday", deadline=None, max_examples=40)
settings.register_profile("deep", deadline=None, max_examples=2000)
settings.load_profile("everyday")


def pytest_itemcollected(item):
    """Hypothesis runs the same lines a hundred times; to measure them takes longer than to run."""
    function = getattr(item, "obj", None)  # a test of launch_testing has none
    if getattr(function, "is_hypothesis_test", False):
        item.add_marker("no_cover")


def pytest_collection_finish():
    """Autograd counts its devices at the first backward. After an ONNX export a torch that is built
    for CUDA counts one that is not there, and then works in no process that is forked, as runs are
    that tests kill. So the first backward comes before all tests.

    What has been imported by then stays: to look through it for garbage takes a while each time."""
    if (torch := sys.modules.get("torch")) is not None:
        torch.ones((), requires_grad=True).backward()
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """no_cover holds for processes that the test starts, too. After it coverage starts again, and
    with each start it wraps os._exit once more: a process that is forked later would save its lines
    as often, for many seconds."""
    with pytest.MonkeyPatch.context() as patch:
        if item.get_closest_marker("no_cover"):
            patch.delenv("COVERAGE_PROCESS_CONFIG", raising=False)
            patch.setattr(os, "_exit", os._exit)
        return (yield)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish():
    """What multiprocessing runs beside us ends now and not some time after us: else coverage would
    combine its data files while they are written."""
    for process in multiprocessing.active_children():
        process.kill()
        process.join()
    forkserver._forkserver._stop()
    resource_tracker._resource_tracker._stop()


@pytest.fixture(scope="session")
def data() -> Path:
    """Real scans that lie beside the checkout, never in it."""
    from samples import DATA
    if not DATA.is_dir():
        pytest.skip("real data is not beside the checkout (../shared/data)")
    return DATA


@pytest.fixture
def carrier_too(monkeypatch):
    """Networks of random weights see things anywhere, also round the sensor: with this they say so.
    What is left out there otherwise: test_contract.py."""
    from lidar_perception.detectors import normalized_view
    monkeypatch.setattr(normalized_view, "drop_ego_vehicle", lambda detections, height: detections)


@pytest.fixture
def one_thread():
    """torch with one thread: small networks are slower with more, and wait for busy cores."""
    import torch

    from lidar_perception.runs.threads import set_thread_count
    before = torch.get_num_threads()
    set_thread_count(1)
    yield
    set_thread_count(before)


@pytest.fixture(scope="module")
def one_thread_for_all():
    """As one_thread, for fixtures of the module too: runs are compared bit by bit, and other
    numbers of threads may add in another order."""
    import torch

    from lidar_perception.runs.threads import set_thread_count
    before = torch.get_num_threads()
    set_thread_count(1)
    yield
    set_thread_count(before)


@pytest.fixture(scope="session")
def streets():
    """Each simulated street is made once in a session, as it never changes."""
    from functools import cache

    from lidar_perception.simulation import drive
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drive, "_make_cached_scene", cache(drive._make_cached_scene.__wrapped__))
        yield


@pytest.fixture(scope="session")
def written(tmp_path_factory) -> Path:
    """The bag of bag_samples.scans(); tests copy what they change."""
    from bag_samples import scans

    from lidar_perception.data.to_bag import write_bag
    path = tmp_path_factory.mktemp("bags") / "drive"
    assert write_bag(path, scans()) == 3
    return path


@pytest.fixture
def tiny_sensor(monkeypatch):
    """The command knows the sensor of simulate_samples."""
    from simulate_samples import TINY

    from lidar_perception.simulation.sensor import SENSORS
    monkeypatch.setitem(SENSORS, "tiny", TINY)


@pytest.fixture(scope="session")
def made(streets, tmp_path_factory) -> Path:
    """A folder of layout -> a data set of five frames that was made in one go."""
    from simulate_samples import TINY, run

    from lidar_perception.simulation.dataset import LAYOUTS
    from lidar_perception.simulation.sensor import SENSORS
    root = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SENSORS, "tiny", TINY)
        for layout in LAYOUTS:
            assert run(root / layout, layout, 5, 1, "--streets-of", 2).exit_code == 0
    return root


@pytest.fixture(scope="session")
def crowds(tmp_path_factory) -> Path:
    """A KITTI folder of people."""
    from experiment_samples import COUNT
    from samples import crowd_folder
    return crowd_folder(tmp_path_factory.mktemp("kitti"), COUNT)


@pytest.fixture(scope="session")
def whole(crowds, tmp_path_factory) -> Path:
    """The folder of a run of the paper's experiment on the crowds that nothing has stopped; beside
    it, what the command said."""
    from experiment_samples import command
    from samples import write
    out = tmp_path_factory.mktemp("whole") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "160")
        write(out.parent / "said", command("--data", crowds, "--out", out, "--jobs", 1))
    return out


@pytest.fixture
def few(tmp_path) -> Path:
    """Five scans for the small experiment."""
    from samples import object_folder
    return object_folder(tmp_path / "few", count=5)

"""pytest fixtures, and the logs of nodes in the report of a test that failed."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

NEEDS_ROS = "needs ROS 2, or the extra [ros]"
FRAMES = 8  # of drive_bag


@pytest.fixture(scope="session")
def domain() -> Iterator[int]:
    """A ROS domain that nobody else uses, reached by this machine only. It is in the environment,
    so that whatever the tests start is on it too."""
    from lidar_perception.candidates.warm_up import warm_up
    from lidar_perception.nodes.graph import reserve_domain
    from lidar_perception.nodes.shared_memory import use_large_shared_memory
    with pytest.MonkeyPatch.context() as patch:
        number = reserve_domain()
        patch.setenv("ROS_DOMAIN_ID", str(number))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        use_large_shared_memory()
        warm_up()  # what nodes compile is cached then; on a fresh machine that can outlast a wait
        yield number


def _processes(domain: int, folder: Path) -> Iterator[Any]:
    pytest.importorskip("rclpy", reason=NEEDS_ROS)
    from lidar_perception.testing.processes import NodesUnderTest
    with NodesUnderTest(folder, domain) as running:
        yield running


def _peer(domain: int, processes: Any) -> Iterator[Any]:
    from lidar_perception.testing.peer import Peer
    with Peer(domain, processes) as peer:
        yield peer


@pytest.fixture
def processes(domain, tmp_path) -> Iterator[Any]:
    """Starts nodes and programs; what still runs at the end of the test is ended. See
    testing/processes.py."""
    yield from _processes(domain, tmp_path / "logs")


@pytest.fixture
def peer(domain, processes) -> Iterator[Any]:
    """A node that listens, talks and waits. See testing/peer.py."""
    yield from _peer(domain, processes)


@pytest.fixture(scope="module")
def shared_processes(domain, tmp_path_factory) -> Iterator[Any]:
    """As processes, for all tests of a module: to start takes longer than to test."""
    yield from _processes(domain, tmp_path_factory.mktemp("logs"))


@pytest.fixture(scope="module")
def shared_peer(domain, shared_processes) -> Iterator[Any]:
    """As peer, for all tests of a module."""
    yield from _peer(domain, shared_processes)


@pytest.fixture(scope="session")
def make_bag(tmp_path_factory) -> Callable[..., Path]:
    """make_bag(clouds, labels=None, storage="mcap", points="/points", ...) writes a bag by rosbags:
    of arrays and labels as bags.recording takes them, or of Frames, such as simulated ones."""
    def make(frames: Any, labels: Any = None, *, storage: str = "mcap", points: str = "/points",
             **options: Any) -> Path:
        from lidar_perception.testing.bags import bag_of, frames_of
        from lidar_perception.wire.topics import POINTS
        return bag_of(tmp_path_factory.mktemp("bag") / "bag", frames_of(frames, labels, **options),
                      storage, {POINTS: points})
    return make


@pytest.fixture(scope="session")
def drive_bag(make_bag) -> Path:
    """A simulated drive among people: eight clouds of 64 beams with labels and a camera."""
    from lidar_perception.simulation.scene import CROWDED
    from lidar_perception.simulation.to_bag import simulated_scans
    return make_bag(simulated_scans(33, FRAMES, scenes=CROWDED))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: Any, call: Any) -> Any:
    report = yield
    running = sys.modules.get("lidar_perception.testing.processes")
    if running is not None and report.failed:
        report.sections += [(f"log of {title}", log) for title, log in running.logs_of_all()]
    return report

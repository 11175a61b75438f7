"""pytest fixtures, and a hook that adds the logs of nodes to the report of a failed test."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

NEEDS_ROS = "needs ROS 2, or the extra [ros]"
FRAME_COUNT = 8  # number of frames in drive_bag


@pytest.fixture(scope="session")
def domain() -> Iterator[int]:
    """Private ROS domain, limited to this machine.

    It is set in the environment, so that programs started by the tests use it too.
    """
    from lidar_perception.candidates.warm_up import warm_up
    from lidar_perception.nodes.graph import reserve_domain
    from lidar_perception.nodes.shared_memory import use_large_shared_memory

    with pytest.MonkeyPatch.context() as patch:
        number = reserve_domain()
        patch.setenv("ROS_DOMAIN_ID", str(number))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        use_large_shared_memory()
        warm_up()  # compile here, because compilation in a node could take longer than a timeout
        yield number


def _start_processes(domain: int, folder: Path) -> Iterator[Any]:
    pytest.importorskip("rclpy", reason=NEEDS_ROS)
    from lidar_perception.testing.processes import NodesUnderTest

    with NodesUnderTest(folder, domain) as nodes:
        yield nodes


def _start_peer(domain: int, processes: Any) -> Iterator[Any]:
    from lidar_perception.testing.peer import Peer

    with Peer(domain, processes) as peer:
        yield peer


@pytest.fixture
def processes(domain, tmp_path) -> Iterator[Any]:
    """NodesUnderTest object that starts nodes and programs, and stops them at the end of the test."""
    yield from _start_processes(domain, tmp_path / "logs")


@pytest.fixture
def peer(domain, processes) -> Iterator[Any]:
    """Peer object: a node that subscribes, publishes and waits."""
    yield from _start_peer(domain, processes)


@pytest.fixture(scope="module")
def shared_processes(domain, tmp_path_factory) -> Iterator[Any]:
    """`processes` shared by all tests of a module, because it takes long to start nodes."""
    yield from _start_processes(domain, tmp_path_factory.mktemp("logs"))


@pytest.fixture(scope="module")
def shared_peer(domain, shared_processes) -> Iterator[Any]:
    """`peer` shared by all tests of a module."""
    yield from _start_peer(domain, shared_processes)


@pytest.fixture(scope="session")
def make_bag(tmp_path_factory) -> Callable[..., Path]:
    """Function that writes a bag: make_bag(clouds, labels=None, storage="mcap", points="/points").

    For clouds, labels and other options see bags.make_frames. Frames, such as simulated ones, can
    be given instead of clouds.
    """

    def make(
        frames: Any, labels: Any = None, *, storage: str = "mcap", points: str = "/points", **options: Any
    ) -> Path:
        from lidar_perception.testing.bags import to_frames, write_rosbags_bag
        from lidar_perception.wire.topics import POINTS

        return write_rosbags_bag(
            tmp_path_factory.mktemp("bag") / "bag", to_frames(frames, labels, **options), storage, {POINTS: points}
        )

    return make


@pytest.fixture(scope="session")
def drive_bag(make_bag) -> Path:
    """Bag of a simulated drive among people: eight clouds of 64 beams, labels and a camera."""
    from lidar_perception.simulation.recording import simulate_frames
    from lidar_perception.simulation.scene import CROWDED_ZONES

    return make_bag(simulate_frames(33, FRAME_COUNT, scenes=CROWDED_ZONES))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: Any, call: Any) -> Any:
    report = yield
    processes_module = sys.modules.get("lidar_perception.testing.processes")
    if processes_module is not None and report.failed:
        report.sections += [(f"log of {title}", log) for title, log in processes_module.collect_logs()]
    return report

"""Fixtures of more than one file: a simulated bag, and a peer on a private ROS domain."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from lidar_perception.nodes.main import use_large_shared_memory

FRAMES = 8
use_large_shared_memory()  # Fast DDS reads its profile once: before any test that imports rclpy


@pytest.fixture(scope="session")
def data() -> Path:
    """Real scans that lie beside the checkout, never in it."""
    from samples import DATA
    if not DATA.is_dir():
        pytest.skip("real data is not beside the checkout (../shared/data)")
    return DATA


@pytest.fixture
def one_thread():
    """torch with one thread: small networks are slower with more, and wait for busy cores."""
    import torch
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def drive_bag(tmp_path_factory) -> Path:
    """A bag of a simulated drive: clouds, labels, camera."""
    from lidar_perception.datasets.to_bag import write_bag
    from lidar_perception.simulation.scene import CROWDED
    from lidar_perception.simulation.to_bag import simulated_scans
    path = tmp_path_factory.mktemp("drive") / "drive"
    write_bag(path, simulated_scans(33, FRAMES, streets=CROWDED))
    return path


@pytest.fixture(scope="session")
def domain() -> int:
    """A ROS domain of this test session's own, reached by this machine only."""
    from lidar_perception.nodes.graph import private_domain
    from lidar_perception.pipeline import warm_up
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    number = private_domain()
    warm_up()  # what nodes compile is cached then; on a fresh machine that can outlast a wait
    os.environ["ROS_DOMAIN_ID"] = str(number)
    return number


@pytest.fixture
def peer(domain):
    pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")
    from ros_peer import Peer
    with Peer(domain) as peer:
        yield peer


@pytest.fixture
def processes(domain, tmp_path):
    """Starts node processes; what still runs at the end of the test is ended."""
    pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")
    from lidar_perception.nodes.graph import Processes
    with Processes(tmp_path / "logs", domain) as running:
        yield running

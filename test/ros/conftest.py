"""Fixtures for tests of nodes: a cloud message, a detector's graph, nodes in this process."""

from multiprocessing import forkserver

import pytest


@pytest.fixture(scope="session")
def domain(domain) -> int:
    """Fork nodes from a process without coverage; nodes in the test process cover nearly all lines."""
    from lidar_perception.testing import forking  # noqa: F401  sets what that process loads

    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("COVERAGE_PROCESS_CONFIG", raising=False)
        forkserver.ensure_running()
    return domain


@pytest.fixture(scope="session")
def good_cloud(drive_bag):
    """First cloud of the simulated drive."""
    from lidar_perception.data.bag import Bag
    from lidar_perception.wire.topics import POINTS

    with Bag(drive_bag) as bag:
        return next(m for _, _, m in bag.messages({POINTS}))


@pytest.fixture(scope="module")
def graph_detections(tested, shared_processes, shared_peer, weights):
    """Detections of the graph of the detector under test."""
    from ros_samples import MARKERS, QUIET

    from lidar_perception.candidates.params import PipelineParams
    from lidar_perception.cli.options import read_config

    for node, remap in tested.graph.items():
        shared_processes.start(
            node,
            remap,
            {
                **read_config(tested.stages, PipelineParams()),
                **({**tested.values(weights), **QUIET} if node == tested.node else {}),
            },
        )
    return shared_peer.listen(f"/{tested.node}/output/detections", MARKERS)


@pytest.fixture(scope="module")
def talker(tested, shared_peer, graph_detections):
    """Publisher of clouds to the detector."""
    from ros_samples import CLOUD

    return shared_peer.advertise(tested.between, CLOUD)


@pytest.fixture
def start_node(domain):
    """Make a node in this process; node.sent collects its messages by topic."""
    from rclpy.parameter import Parameter

    from lidar_perception.nodes.external_node import create_context, shut_down_context

    context, nodes = create_context(domain), []

    def make(kind, **values):
        overrides = [Parameter(k, value=list(v) if isinstance(v, tuple) else v) for k, v in values.items() if v != ()]
        node = kind(context=context, parameter_overrides=overrides)
        nodes.append(node)
        node.start()
        assert node.inputs.is_open
        node.sent = {}
        for output in node.outputs.items:
            output.publisher.publish = node.sent.setdefault(output.topic_name.rpartition("/")[2], []).append
        return node

    yield make
    shut_down_context(context, *nodes)

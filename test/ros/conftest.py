"""What tests of nodes share: a cloud as a message, nodes in this process."""

from multiprocessing import forkserver

import pytest


@pytest.fixture(scope="session")
def domain(domain) -> int:
    """The nodes of these tests are forked from a process whose lines are not measured: tests with a
    node in their own process run nearly all of them."""
    from lidar_perception.testing import forking  # noqa: F401  it says what that process loads
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("COVERAGE_PROCESS_CONFIG", raising=False)
        forkserver.ensure_running()
    return domain


@pytest.fixture(scope="session")
def good_cloud(drive_bag):
    """The first of the simulated drive."""
    from lidar_perception.data.bag import Bag
    from lidar_perception.wire.topics import POINTS
    with Bag(drive_bag) as bag:
        return next(m for _, _, m in bag.messages({POINTS}))


@pytest.fixture(scope="module")
def found(request, shared_processes, shared_peer, weights):
    """What the graph of the module's DETECTOR detects with its weights."""
    from test_bad_input import MARKERS, QUIET

    from lidar_perception.candidates.params import PipelineParams
    from lidar_perception.cli.options import read_config
    tested = request.module.DETECTOR
    for node, remap in tested.graph.items():
        shared_processes.start(node, remap, {**read_config(tested.stages, PipelineParams()), **(
            {**tested.values(weights), **QUIET} if node == tested.node else {})})
    return shared_peer.listen(f"/{tested.node}/output/detections", MARKERS)


@pytest.fixture(scope="module")
def talker(request, shared_peer, found):
    """Straight to the detector."""
    from test_bad_input import CLOUD
    return shared_peer.advertise(request.module.DETECTOR.between, CLOUD)


@pytest.fixture
def start(domain):
    """Makes a node in this process; what it publishes grows in node.sent, by topic."""
    from rclpy.parameter import Parameter

    from lidar_perception.nodes.external_node import create_context, shut_down_context
    context, nodes = create_context(domain), []

    def make(kind, **values):
        overrides = [Parameter(k, value=list(v) if isinstance(v, tuple) else v)
                     for k, v in values.items() if v != ()]
        node = kind(context=context, parameter_overrides=overrides)
        nodes.append(node)
        node.start()
        assert node.active
        node.sent = {}
        for output in node._outputs:
            output.publisher.publish = node.sent.setdefault(
                output.topic_name.rpartition("/")[2], []).append
        return node

    yield make
    shut_down_context(context, *nodes)

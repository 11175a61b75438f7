"""What tests of nodes share: a cloud as a message, nodes in this process."""

import pytest


@pytest.fixture(scope="session")
def good_cloud(drive_bag):
    """The first of the simulated drive."""
    from lidar_perception.data.bag import Bag
    from lidar_perception.wire.topics import POINTS
    with Bag(drive_bag) as bag:
        return next(m for _, _, m in bag.messages({POINTS}))


@pytest.fixture
def start(domain):
    """Makes a node in this process; what it publishes grows in node.sent, by topic."""
    import rclpy
    from rclpy.context import Context
    from rclpy.parameter import Parameter
    from rclpy.signals import SignalHandlerOptions
    context, nodes = Context(), []
    rclpy.init(context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)

    def make(kind, **values):
        overrides = [Parameter(k, value=list(v) if isinstance(v, tuple) else v)
                     for k, v in values.items() if v != ()]
        node = kind(context=context, parameter_overrides=overrides)
        nodes.append(node)
        node.start()
        assert node.active
        node.sent = {}
        for publisher in node._outputs:
            publisher.publish = node.sent.setdefault(
                publisher.topic_name.rpartition("/")[2], []).append
        return node

    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown(context=context)

"""A node in the test's own process, to talk to the nodes under test over DDS."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic
from typing import Any

from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile

from lidar_perception.nodes.runtime import RELIABLE
from lidar_perception.nodes.watch import Outside
from lidar_perception.wire.codec import decode, encode
from msg_utils.messages import message_class

TIMEOUT = 60.0  # seconds; the first start on a machine compiles


class Peer(Outside):
    def __init__(self, domain: int):
        super().__init__(domain, "peer")

    def listen(self, topic: str, type_name: str, qos: QoSProfile = RELIABLE) -> list:
        """A list that grows with the messages of a topic."""
        received: list = []
        self.node.create_subscription(message_class(type_name), topic,
                                      lambda data: received.append(decode(data, type_name)), qos,
                                      raw=True)
        return received

    def listen_raw(self, topic: str, type_name: str, qos: QoSProfile = RELIABLE) -> list[bytes]:
        received: list[bytes] = []
        self.node.create_subscription(message_class(type_name), topic, received.append, qos,
                                      raw=True)
        return received

    def talker(self, topic: str, type_name: str, qos: QoSProfile = RELIABLE) -> Any:
        return self.node.create_publisher(message_class(type_name), topic, qos)

    def send(self, publisher: Any, message: Any, until: Callable[[], Any], what: str) -> None:
        """Publish, and again every half second, until a condition holds: a best-effort subscriber
        may not know the publisher yet when the publisher knows it."""
        data, again = encode(message), 0.0

        def condition() -> Any:
            nonlocal again
            if monotonic() >= again and publisher.get_subscription_count():
                publisher.publish(data)
                again = monotonic() + 0.5
                return False
            return until()

        self.wait(condition, what)

    def wait(self, condition: Callable[[], Any], what: str, timeout: float = TIMEOUT) -> None:
        """Spin until condition() holds; fail naming what was waited for."""
        assert self.until(condition, timeout), \
            f"waited {timeout:.0f} s in vain for {what}; diagnostics: " \
            + str({k: v.message for k, v in self.diagnostics.items()})

    def call(self, service: str, kind: type, request: Any) -> Any:
        client = self.node.create_client(kind, service)
        self.wait(client.service_is_ready, f"service {service}")
        future = client.call_async(request)
        self.wait(future.done, f"answer of {service}")
        self.node.destroy_client(client)
        return future.result()

    def set_parameter(self, node: str, name: str, value: Any) -> None:
        request = SetParameters.Request(parameters=[Parameter(name, value=value)
                                                    .to_parameter_msg()])
        result, = self.call(f"{node}/set_parameters", SetParameters, request).results
        assert result.successful, result.reason

"""Inputs of a node. A message that cannot be processed is reported and does not end the node."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message

from lidar_perception.nodes.diagnostics import ERROR, SUMMED_COUNTS, WARN, Problem
from lidar_perception.nodes.interfaces import CLOUD
from lidar_perception.nodes.reception import Reception
from lidar_perception.types import InputError
from lidar_perception.wire.codec import decode, load_typestore, warm_up_type
from msg_utils.messages import load_message_class


class Inputs:
    """The inputs of a node, opened and closed together.

    Attributes:
        items: subscriptions, and other objects with open() and close().
        is_open: True if new subscriptions are opened immediately.
    """

    def __init__(self, node: Any):
        self.node = node
        self.items: list[Any] = []
        self.is_open = True

    def subscribe(
        self,
        topic: str,
        type_name: str,
        callback: Callable,
        *qos: QoSProfile,
        private: bool = True,
        needs: Callable[[Any], str | None] = lambda _: None,
    ) -> None:
        """Subscribe to a topic.

        Args:
            topic: name below ~/input, or with private=False the full name.
            type_name: message type such as "std_msgs/msg/Bool".
            callback: called with each message. Its class is that of rosbags, which offline code
                also uses; it is a view of the received bytes, whereas rclpy copies them several
                times. Types that rosbags does not know have the class of rclpy.
            qos: profiles, each for its own subscription, because one profile may not match all
                publishers. Without any, the topic has a Reception.
            private: True if the topic is below ~/input.
            needs: returns a description of the data from another input that a cloud still needs, or
                None.
        """
        name = f"~/input/{topic}" if private else topic
        warm_up_type(type_name)
        handler = _MessageHandler(self.node, name, type_name, callback, needs, retries_clouds=bool(qos))
        items: list[Any] = [
            MessageInput(handler, profile, is_first=profile is qos[0], is_only=len(qos) == 1) for profile in qos
        ]
        if not qos:
            what = "cloud" if type_name == CLOUD else "array"
            message_class = load_message_class(type_name)
            items = [Reception(self.node, message_class, name, handler, lambda: self.node.node_params.input, what)]
        self.items += items
        if self.is_open:
            for item in items:
                item.open()

    @property
    def receptions(self) -> list[Reception]:
        return [item for item in self.items if isinstance(item, Reception)]

    def open(self) -> None:
        """Open all inputs."""
        self.is_open = True
        for item in self.items:
            item.open()

    def close(self) -> None:
        """Close all inputs, so that no message arrives until open()."""
        self.is_open = False
        for item in self.items:
            item.close()

    def retry(self) -> None:
        """Deliver the waiting clouds again, because their other inputs may have arrived."""
        for reception in self.receptions:
            reception.retry()

    def adapt(self) -> None:
        """Adapt to changed publishers, for middleware that does not report changes."""
        for reception in self.receptions:
            reception.adapt()

    def values(self) -> dict[str, Any]:
        """Return the values for the diagnostics. For equal keys, the value of the first input counts."""
        values: dict[str, Any] = {}
        for reception in self.receptions:
            for key, value in reception.values().items():
                values[key] = values.get(key, 0) + value if key in SUMMED_COUNTS else values.get(key, value)
        return values

    def problems(self) -> list[Problem]:
        """Return the present problems of all receptions with their remedies."""
        return [problem for reception in self.receptions for problem in reception.problems()]


@dataclass
class _MessageHandler:
    """Decodes the messages of a topic, passes them to a callback and reports errors."""

    node: Any
    name: str
    type_name: str
    callback: Callable
    needs: Callable[[Any], str | None]
    retries_clouds: bool  # True if waiting clouds may need these messages

    def __call__(self, data: Any, may_wait: bool = False) -> str | None:
        """Handle a message, as CDR or decoded; return a description of the data that a cloud still needs, or None.

        A cloud that may wait and still needs data is not passed to the callback.
        """
        missing = None
        try:
            msg = decode_message(data, self.type_name) if isinstance(data, bytes) else data
            is_cloud = self.type_name == CLOUD
            if is_cloud:
                self.node.diagnostics.frame_id = msg.header.frame_id
                missing = self.node.transforms.find_missing_input(msg)
            missing = missing or self.needs(msg)
            if missing is None or not may_wait:
                self.callback(self.node.transforms.deskew_cloud(msg) if is_cloud else msg)
        except InputError as error:
            self._report(str(error))
        except Exception as error:
            self.node.get_logger().error(traceback.format_exc())
            self._report(f"{type(error).__name__}: {error}; this is a bug, please report it with this message")
        if self.retries_clouds:
            self.node.inputs.retry()
        return missing

    def _report(self, message: str) -> None:
        self.node.diagnostics.report(ERROR, f"{self.node.resolve_topic_name(self.name)}: {message}")


class MessageInput:
    """An input with a plain subscription, for messages other than clouds.

    Args:
        handler: called with each message as CDR.
        qos: profile of the subscription.
        is_first: True for the first of several subscriptions, to which qos_overrides apply.
        is_only: True if the topic has no other subscription, so an incompatible QoS is a problem.
    """

    def __init__(self, handler: _MessageHandler, qos: QoSProfile, is_first: bool, is_only: bool):
        self.handler, self.qos, self.is_first, self.is_only = handler, qos, is_first, is_only
        self.node = handler.node
        self.subscription: Any = None

    def open(self) -> None:
        on_message: Any = self.handler  # rclpy's type annotation lacks the return value
        self.subscription = self.node.create_subscription(
            load_message_class(self.handler.type_name),
            self.handler.name,
            on_message,
            self.qos,
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(
                message_lost=self.node.diagnostics.count_lost, incompatible_qos=self._report_incompatible
            ),
            qos_overriding_options=QoSOverridingOptions.with_default_policies() if self.is_first else None,
        )

    def _report_incompatible(self, event: Any) -> None:
        if not self.is_only:
            return
        topic = self.node.resolve_topic_name(self.handler.name)
        remedy = (
            "make it publish transient local (ros2 bag play: --qos-profile-overrides-path)"
            if event.last_policy_kind == QoSPolicyKind.DURABILITY
            else f"make it publish reliable, or set qos_overrides.{topic}.subscription.reliability to best_effort"
        )
        self.node.diagnostics.report(
            WARN, f"a publisher on {topic} offers an incompatible QoS, so none of its messages arrive: {remedy}"
        )

    def close(self) -> None:
        if self.subscription is not None:
            self.node.destroy_subscription(self.subscription)
        self.subscription = None


def decode_message(data: bytes, type_name: str) -> Any:
    """Decode CDR to a rosbags message, or to an rclpy message if rosbags does not know the type."""
    if type_name in load_typestore().fielddefs:
        return decode(data, type_name)
    return deserialize_message(data, load_message_class(type_name))

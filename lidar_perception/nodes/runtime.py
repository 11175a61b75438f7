"""Base class of all nodes: parameters from dataclasses, QoS, diagnostics, receive callbacks."""

from __future__ import annotations

import re
import traceback
from collections.abc import Callable
from contextlib import contextmanager
from functools import partial
from time import monotonic, perf_counter
from typing import Any, ClassVar

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from rclpy.task import Future
from std_msgs.msg import Float64

from lidar_perception.nodes.links import Links, Output
from lidar_perception.nodes.parameter_declaration import convert_to_declared_type, declare_parameters
from lidar_perception.nodes.rclpy_compat import UnknownParameterError, parameter_names
from lidar_perception.nodes.reception import Problem, Reception
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.types import InputError, closest_name
from lidar_perception.wire.codec import decode, encode, load_typestore, make_bag_message
from msg_utils.messages import load_message_class

CLOUD = "sensor_msgs/msg/PointCloud2"
MARKERS = "visualization_msgs/msg/MarkerArray"

SENSOR_DATA = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=10)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
JUMP_NS = 10**9  # a stamp that goes back by more than this means that a bag has restarted
WAITING = "waiting for input"
LOG_PERIOD_S = 60.0  # pause before the same problem is logged again
MAX_LOGGED_KINDS = 1000  # maximum number of message kinds whose last log time is stored


class LidarNode(Node):
    """A node that reports bad input as a diagnostic instead of ending.

    Args:
        name: name of the node.
        params: dataclass with the parameters of the algorithm. Its fields are declared as ROS
            parameters, and changes at run time are checked in the same way.
        node_params: dataclass with the other parameters, such as CloudNodeParams or BoxNodeParams,
            for nodes that subscribe to clouds.
        links: links to the other nodes of the process, None if there are none.
        options: further arguments of rclpy.node.Node.
    """

    transforms: Any = None  # a Transforms object for nodes that subscribe to clouds
    writes_files: ClassVar[bool] = False  # True if close() writes files, so a signal must not cut off the work

    def __init__(self, name: str, params: Any, node_params: Any = None, links: Links | None = None, **options: Any):
        super().__init__(name, **options)
        self.links = links
        self._outputs: list[Output] = []
        self.params = declare_parameters(self, params)
        self.node_params = node_params and declare_parameters(self, node_params)
        self.add_pre_set_parameters_callback(self._before_set)
        self.add_on_set_parameters_callback(self._on_set)
        self.stop = Future()  # any thread may set it to end the node
        self.state = (WARN, WAITING)
        self.active = True  # True while the node subscribes to its inputs
        self.reset_state()
        self._present: set[str] = set()  # kinds of the current problems
        self._logged: dict[str, float] = {}  # kind of message -> time of its last log line
        self._last_logged = ""
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", RELIABLE)
        self._processing_time = self.create_publisher(Float64, "~/debug/processing_time_ms", RELIABLE)
        self.add_steady_timer(1.0, self._tick)

    def reset_state(self) -> None:
        """Reset the counts, and forget all inputs and outputs."""
        self.counts: dict[str, Any] = {"frames": 0, "lost": 0}
        self.last_stamp_ns = 0
        self.times: list[float] = []
        self.frame_id = ""  # frame of the last cloud
        self.inputs: list[Any] = []  # objects with open() and close()
        for output in self._outputs:
            output.close()
        self._outputs = []

    def add_steady_timer(self, seconds: float, callback: Callable[[], None]) -> None:
        """Call callback() periodically, also while the clock of a simulation stands still."""
        self.create_timer(seconds, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def count_lost(self, event: Any) -> None:
        """Count the messages that the middleware reports as lost."""
        self.counts["lost"] += event.total_count_change

    def start(self) -> None:
        """Start the work of the node; called once before it spins."""

    def is_ready(self) -> bool:
        """Return True once the node processes its input."""
        return True

    def _before_set(self, changes: list[Parameter]) -> list[Parameter]:
        if unknown := [c.name for c in changes if not self.has_parameter(c.name)]:
            guess = closest_name(unknown[0], parameter_names(self))
            raise UnknownParameterError(
                f"{self.get_fully_qualified_name()} has no parameter "
                f"{unknown[0][:80]!r}" + (f"; did you mean {guess!r}?" if guess else "")
            )
        return [convert_to_declared_type(c, self.get_parameter(c.name).type_) for c in changes]

    def _on_set(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            params, node_params = (
                group and with_values(group, {c.name: c.value for c in changes if c.name in flatten(group)})
                for group in (self.params, self.node_params)
            )
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self.params, self.node_params = params, node_params
        return SetParametersResult(successful=True)

    def input(
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
            topic: ~/input/TOPIC, or with private=False the name itself.
            type_name: message type such as "std_msgs/msg/Bool".
            callback: called with each message, in the class of rosbags that offline code reads from
                bags. It is a view of the received bytes, which rclpy copies several times. Types
                that rosbags does not know have the class of rclpy.
            qos: each profile gets its own subscription, as one may not match all publishers.
                Without any, the topic has a Reception.
            private: the topic is below ~/input.
            needs: what a cloud still waits for from another input, or None.
        """
        name = f"~/input/{topic}" if private else topic
        _warm_up_type(type_name)

        def receive(data: Any, patient: bool = False) -> str | None:
            missing = None
            try:
                msg = decode_message(data, type_name) if isinstance(data, bytes) else data
                if type_name == CLOUD:
                    self.frame_id = msg.header.frame_id
                    missing = self.transforms.find_missing_input(msg)
                missing = missing or needs(msg)
                if missing is None or not patient:
                    callback(self.transforms.deskew_cloud(msg) if type_name == CLOUD else msg)
            except InputError as error:
                self.report(ERROR, f"{self.resolve_topic_name(name)}: {error}")
            except Exception as error:
                self.get_logger().error(traceback.format_exc())
                self.report(
                    ERROR,
                    f"{self.resolve_topic_name(name)}: {type(error).__name__}: "
                    f"{error}; this is a bug, please report it with the message",
                )
            if qos:
                for reception in self._receptions():
                    reception.retry()
            return missing

        untyped_receive: Any = receive  # rclpy's type annotation lacks the return value
        kind, what = load_message_class(type_name), "cloud" if type_name == CLOUD else "array"

        def report_incompatible(event: Any) -> None:
            if len(qos) > 1:
                return  # another QoS profile matches
            topic = self.resolve_topic_name(name)
            remedy = (
                "make it publish transient local (ros2 bag play: --qos-profile-overrides-path)"
                if event.last_policy_kind == QoSPolicyKind.DURABILITY
                else f"make it publish reliable, or set qos_overrides.{topic}.subscription.reliability to best_effort"
            )
            self.report(
                WARN, f"a publisher on {topic} offers an incompatible QoS, so none of its messages arrive: {remedy}"
            )

        events = SubscriptionEventCallbacks(message_lost=self.count_lost, incompatible_qos=report_incompatible)

        def subscribe(profile: QoSProfile) -> Any:
            return self.create_subscription(
                kind,
                name,
                untyped_receive,
                profile,
                raw=True,
                event_callbacks=events,
                qos_overriding_options=QoSOverridingOptions.with_default_policies() if profile is qos[0] else None,
            )

        inputs: list[Any] = [MessageInput(self, partial(subscribe, profile)) for profile in qos] or [
            Reception(self, kind, name, receive, lambda: self.node_params.input, what)
        ]
        self.inputs += inputs
        if self.active:
            for new_input in inputs:
                new_input.open()

    def output(self, topic: str, type_name: str, qos: QoSProfile = RELIABLE) -> Output:
        """Create a publisher of ~/output/TOPIC, or of any name that starts with ~ or /."""
        name = topic if topic[0] in "~/" else f"~/output/{topic}"
        _warm_up_type(type_name)
        output = Output(
            self.create_publisher(
                load_message_class(type_name),
                name,
                qos,
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            ),
            self.links,
        )
        self._outputs.append(output)
        return output

    def report(self, level: bytes, message: str, expected: bool = False) -> None:
        """Set the diagnostic state.

        A message that differs from the last one in more than its numbers is logged and published at
        once. Expected states, such as waiting for input after the start, are logged as information.
        """
        kind, before = _mask_numbers(message), (self.state[0], _mask_numbers(self.state[1]))
        self.state = (level, message)
        if (level, kind) != before:
            self._log_rarely(kind, OK if expected else level, message)
            self.publish_diagnostics()

    def _log_rarely(self, kind: str, level: bytes, message: str) -> None:
        """Log a problem at most once in LOG_PERIOD_S, and an OK state unless it was logged last, so
        that the log always ends with the current state."""
        now = monotonic()
        if kind != self._last_logged if level == OK else now - self._logged.get(kind, -LOG_PERIOD_S) >= LOG_PERIOD_S:
            if len(self._logged) > MAX_LOGGED_KINDS:
                self._logged.clear()
            self._logged[kind], self._last_logged = now, kind
            self._log(level, message)

    def _log(self, level: bytes, message: str) -> None:
        if level == OK:  # one call for each level: rclpy binds the level to the calling line
            self.get_logger().info(message)
        elif level == WARN:
            self.get_logger().warning(message)
        else:
            self.get_logger().error(message)

    @contextmanager
    def frame(self, stamp_ns: int):
        """Count and time the work on one cloud, and detect stamps that jump back."""
        if stamp_ns < self.last_stamp_ns - JUMP_NS:
            self.counts["time_went_back"] = self.counts.get("time_went_back", 0) + 1
            self.get_logger().info(
                "time jumped back, as when a bag restarts; dropping pending data (logged once, counted in "
                "/diagnostics)",
                once=True,
            )
        self.last_stamp_ns = stamp_ns
        begin = perf_counter()
        yield
        elapsed = (perf_counter() - begin) * 1e3
        self._processing_time.publish(Float64(data=elapsed))
        self.times = [*self.times[-99:], elapsed]
        self.counts["frames"] += 1

    def publish_diagnostics(self) -> None:
        """Publish the state with the problems of the inputs and of the name of the node."""
        level, message = self.state
        values = dict(self.counts, last_stamp_ns=self.last_stamp_ns)
        for source in reversed(self._sources()):  # the first input wins for equal keys
            values.update(source.values())
        for name in ("lost", "dropped"):
            if numbers := [r.values()[name] for r in self._receptions()]:
                values[name] = sum(numbers, self.counts.get(name, 0))
        if self.times:
            values["processing_ms_median"] = f"{np.median(self.times):.1f}"
        for output in self._outputs:
            values[f"subscribers of {output.topic_name}"] = output.get_subscription_count()
        if problems := self._problems():
            level = max(level, *(p[1] for p in problems))
            message = f"{'; '.join(p[2] for p in problems)} (state: {message})"
        status = DiagnosticStatus(
            level=level,
            name=self.get_fully_qualified_name().lstrip("/"),
            message=message,
            hardware_id=self._hardware_id(),
            values=[KeyValue(key=k, value=str(v)) for k, v in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        if rclpy.ok(context=self.context):
            self._diagnostics.publish(array)

    def _receptions(self) -> list[Reception]:
        return [source for source in self.inputs if isinstance(source, Reception)]

    def _sources(self) -> list[Any]:
        """Return the objects with their own diagnostic values and problems."""
        return [*self._receptions(), *([self.transforms] if self.transforms else [])]

    def _problems(self) -> list[Problem]:
        """Return all present problems and log the new ones."""
        found = [p for source in self._sources() for p in source.problems()]
        name, namespace = self.get_name(), self.get_namespace()
        if self.get_node_names_and_namespaces().count((name, namespace)) > 1:
            found.append(
                (
                    "name",
                    WARN,
                    f"another node is also called {self.get_fully_qualified_name()}, "
                    "so their topics and parameters are mixed; stop one, or change its namespace",
                )
            )
        before, self._present = self._present, {kind for kind, _, _ in found}
        for kind, level, message in found:
            if kind not in before:
                self._log_rarely(kind, level, message)
        return found

    def _hardware_id(self) -> str:
        """Return the namespace and the frame of the clouds, which identify the sensor."""
        parts = self.get_namespace().strip("/"), self.frame_id
        return "/".join(filter(None, parts)) or "lidar_perception"

    def _tick(self) -> None:
        for reception in self._receptions():
            reception.adapt()  # needed for middleware without QoS events
            reception.retry()
        self.publish_diagnostics()

    def spin(self, executor: Executor) -> None:
        """Spin until self.stop is done."""
        executor.spin_until_future_complete(self.stop)

    def close(self) -> None:
        """Write results that are still in memory; called once before the node is destroyed.

        Raises:
            InputError: the results cannot be written.
        """


def decode_message(data: bytes, type_name: str) -> Any:
    """Decode CDR to the class of rosbags, or of rclpy for types that rosbags does not know."""
    if type_name in load_typestore().fielddefs:
        return decode(data, type_name)
    return deserialize_message(data, load_message_class(type_name))


class MessageInput:
    """An input with a plain subscription, for messages other than clouds."""

    def __init__(self, node: Node, subscribe: Callable[[], Any]):
        self.node, self.subscribe = node, subscribe
        self.subscription: Any = None

    def open(self) -> None:
        self.subscription = self.subscribe()

    def close(self) -> None:
        if self.subscription is not None:
            self.node.destroy_subscription(self.subscription)
        self.subscription = None


def _mask_numbers(message: str) -> str:
    """Return the message with all numbers replaced by 0."""
    return re.sub(r"\d[\d.,e+-]*", "0", message)


def _warm_up_type(type_name: str) -> None:
    """Let rosbags generate its code for a type before the first message arrives."""
    if type_name in load_typestore().fielddefs:
        decode(encode(make_bag_message(type_name)), type_name)

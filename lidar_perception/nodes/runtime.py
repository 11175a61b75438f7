"""What all nodes share: parameters from a dataclass, QoS, diagnostics, guarded callbacks."""

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
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from rclpy.task import Future
from std_msgs.msg import Float64

from lidar_perception.nodes.declared import as_declared, declare
from lidar_perception.nodes.reception import Problem, Reception
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.types import InputError, closest_name
from lidar_perception.wire.codec import bag_message, decode, encode, load_typestore
from msg_utils.messages import message_class

CLOUD = "sensor_msgs/msg/PointCloud2"
MARKERS = "visualization_msgs/msg/MarkerArray"

SENSOR_DATA = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=10)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
JUMP_NS = 10**9  # stamps that go back by more than this are a bag that starts again
WAITING = "waiting for input"
LOG_PERIOD = 60.0  # seconds before the same problem is logged again
MAX_KINDS = 1000   # of messages whose last time is known


class UnknownParameter(ParameterNotDeclaredException):
    """A parameter that is set but not declared; rclpy catches it, and answers with its message.

    rclpy 7's own message is "Invalid access to undeclared parameter(s): []", because any() has
    taken the name from a generator (rclpy/node.py, _check_undeclared_parameters).
    """

    def __init__(self, message: str):
        Exception.__init__(self, message)


class LidarNode(Node):
    """A node whose callbacks never end it: bad input becomes a diagnostic.

    params is a dataclass of params.py; its fields are declared as ROS parameters, and a change at
    run time goes through the same checks. So is robot, what the node has besides its algorithm's
    numbers: CloudNodeParams, BoxNodeParams ... where it takes clouds; transforms are its frames
    then.
    """

    transforms: Any = None  # of transforms.py
    writes_files: ClassVar[bool] = False  # that close() completes, so a signal waits for the work

    def __init__(self, name: str, params: Any, robot: Any = None, **options: Any):
        super().__init__(name, **options)
        self.params = declare(self, params)
        self.robot = robot and declare(self, robot)
        self.add_pre_set_parameters_callback(self._before_set)
        self.add_on_set_parameters_callback(self._on_set)
        self.stop = Future()  # done when the node shall end; set from any thread
        self.state = (WARN, WAITING)
        self.active = True  # listens to its inputs
        self.forget()
        self._present: set[str] = set()  # kinds of problems
        self._logged: dict[str, float] = {}  # kind of message -> when it was logged
        self._last_logged = ""
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", RELIABLE)
        self._processing_time = self.create_publisher(Float64, "~/debug/processing_time_ms",
                                                      RELIABLE)
        self.every(1.0, self._tick)

    def forget(self) -> None:
        """What is known of the input and output so far."""
        self.counts: dict[str, Any] = {"frames": 0, "lost": 0}
        self.last_stamp_ns = 0
        self.times: list[float] = []
        self.frame_id = ""  # of the last cloud
        self.inputs: list[Any] = []  # with open() and close()
        self._outputs: list[Any] = []

    def every(self, seconds: float, work: Callable[[], None]) -> None:
        """Do it again and again, also while the clock of a simulation stands."""
        self.create_timer(seconds, work, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def count_lost(self, event: Any) -> None:
        """Of a subscription: messages that were lost on the way."""
        self.counts["lost"] += event.total_count_change

    def start(self) -> None:
        """Called once, when the node is made and before it spins."""

    def is_ready(self) -> bool:
        """Return True once the node works on its input."""
        return True

    def _before_set(self, changes: list[Parameter]) -> list[Parameter]:
        if unknown := [c.name for c in changes if not self.has_parameter(c.name)]:
            guess = closest_name(unknown[0], self._parameters)
            raise UnknownParameter(f"{self.get_fully_qualified_name()} has no parameter "
                                   f"{unknown[0][:80]!r}" + (f"; did you mean {guess!r}?"
                                                             if guess else ""))
        return [as_declared(c, self.get_parameter(c.name).type_) for c in changes]

    def _on_set(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            own, robot = (group and with_values(
                group, {c.name: c.value for c in changes if c.name in flatten(group)})
                for group in (self.params, self.robot))
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self.params, self.robot = own, robot
        return SetParametersResult(successful=True)

    def input(self, topic: str, type_name: str, callback: Callable,
              *qos: QoSProfile, private: bool = True,
              needs: Callable[[Any], str | None] = lambda _: None) -> None:
        """Subscribe to ~/input/TOPIC, or with private=False to the name as it is. callback gets
        rosbags' class of the message, the one that offline code reads from bags: it views the
        received bytes, where rclpy's own class copies them several times. Types that rosbags does
        not come with are of rclpy's class. With several qos each is subscribed to, as no one of
        them may fit all publishers. Without qos the topic is received as reception.py does: needs
        says what a cloud still waits for, which comes by another input, and None if nothing.
        """
        name = f"~/input/{topic}" if private else topic
        _warm_up_type(type_name)

        def guarded(data: bytes, patient: bool = False) -> str | None:
            missing = None
            try:
                msg = decoded(data, type_name)
                if type_name == CLOUD:
                    self.frame_id = msg.header.frame_id
                    missing = self.transforms.missing(msg)
                missing = missing or needs(msg)
                if missing is None or not patient:
                    callback(self.transforms.corrected(msg) if type_name == CLOUD else msg)
            except InputError as error:
                self.report(ERROR, f"{self.resolve_topic_name(name)}: {error}")
            except Exception as error:
                self.get_logger().error(traceback.format_exc())
                self.report(ERROR, f"{self.resolve_topic_name(name)}: {type(error).__name__}: "
                            f"{error}; this is a bug, please report it with the message")
            if qos:
                for reception in self._receptions():
                    reception.try_again()
            return missing

        received: Any = guarded  # rclpy's annotation has no result
        kind, what = message_class(type_name), "cloud" if type_name == CLOUD else "array"

        def refused(event: Any) -> None:
            if len(qos) > 1:
                return  # another of them fits
            topic = self.resolve_topic_name(name)
            remedy = ("let it publish transient local (ros2 bag play: --qos-profile-overrides-path)"
                      if event.last_policy_kind == QoSPolicyKind.DURABILITY else
                      "let it publish reliable, or set "
                      f"qos_overrides.{topic}.subscription.reliability to best_effort")
            self.report(WARN, f"a publisher on {topic} offers less than is asked for, and is not "
                        f"heard: {remedy}")

        events = SubscriptionEventCallbacks(message_lost=self.count_lost, incompatible_qos=refused)

        def subscribe(profile: QoSProfile) -> Any:
            return self.create_subscription(
                kind, name, received, profile, raw=True, event_callbacks=events,
                qos_overriding_options=QoSOverridingOptions.with_default_policies()
                if profile is qos[0] else None)

        added: list[Any] = (
            [Subscribed(self, partial(subscribe, profile)) for profile in qos]
            or [Reception(self, kind, name, guarded, lambda: self.robot.input, what)])
        self.inputs += added
        if self.active:
            for made in added:
                made.open()

    def output(self, topic: str, type_name: str, qos: QoSProfile = RELIABLE):
        """Publisher of ~/output/TOPIC, or of any name that starts with ~ or /; it takes encode()d
        messages."""
        name = topic if topic[0] in "~/" else f"~/output/{topic}"
        _warm_up_type(type_name)
        publisher = self.create_publisher(
            message_class(type_name), name, qos,
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        self._outputs.append(publisher)
        return publisher

    def report(self, level: bytes, message: str, expected: bool = False) -> None:
        """Set the diagnostic state. A change to a message of another kind, which is more than other
        numbers in it, is logged and published at once. What is expected, such as that a node waits
        at its start, is no warning in the log."""
        kind, before = _kind_of(message), (self.state[0], _kind_of(self.state[1]))
        self.state = (level, message)
        if (level, kind) != before:
            self._log_seldom(kind, OK if expected else level, message)
            self.publish_diagnostics()

    def _log_seldom(self, kind: str, level: bytes, message: str) -> None:
        """A problem at most once in LOG_PERIOD; what is no problem unless it was the last to say,
        so that a log ends with how it is."""
        now = monotonic()
        if (kind != self._last_logged if level == OK else
                now - self._logged.get(kind, -LOG_PERIOD) >= LOG_PERIOD):
            if len(self._logged) > MAX_KINDS:
                self._logged.clear()
            self._logged[kind], self._last_logged = now, kind
            self._log(level, message)

    def _log(self, level: bytes, message: str) -> None:
        if level == OK:  # one line a level: rclpy ties the level to the place of the call
            self.get_logger().info(message)
        elif level == WARN:
            self.get_logger().warning(message)
        else:
            self.get_logger().error(message)

    @contextmanager
    def frame(self, stamp_ns: int):
        """Around the work on one cloud: counts it, times it, notices that time went back."""
        if stamp_ns < self.last_stamp_ns - JUMP_NS:
            self.counts["time_went_back"] = self.counts.get("time_went_back", 0) + 1
            self.get_logger().info("time went back, as of a bag that starts again; what waited "
                                   "from before is dropped (said once, counted in /diagnostics)",
                                   once=True)
        self.last_stamp_ns = stamp_ns
        begin = perf_counter()
        yield
        elapsed = (perf_counter() - begin) * 1e3
        self._processing_time.publish(Float64(data=elapsed))
        self.times = [*self.times[-99:], elapsed]
        self.counts["frames"] += 1

    def publish_diagnostics(self) -> None:
        """The state, and what is wrong with the inputs and with the node's name."""
        level, message = self.state
        values = dict(self.counts, last_stamp_ns=self.last_stamp_ns)
        for source in reversed(self._sources()):  # of equal names that of the first input
            values.update(source.values())
        for name in ("lost", "dropped"):
            if numbers := [r.values()[name] for r in self._receptions()]:
                values[name] = sum(numbers, self.counts.get(name, 0))
        if self.times:
            values["processing_ms_median"] = f"{np.median(self.times):.1f}"
        for publisher in self._outputs:
            values[f"subscribers of {publisher.topic_name}"] = publisher.get_subscription_count()
        if problems := self._problems():
            level = max(level, *(p[1] for p in problems))
            message = f"{'; '.join(p[2] for p in problems)} (state: {message})"
        status = DiagnosticStatus(level=level, name=self.get_fully_qualified_name().lstrip("/"),
                                  message=message, hardware_id=self._hardware_id(),
                                  values=[KeyValue(key=k, value=str(v)) for k, v in values.items()])
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        if rclpy.ok(context=self.context):
            self._diagnostics.publish(array)

    def _receptions(self) -> list[Reception]:
        return [made for made in self.inputs if isinstance(made, Reception)]

    def _sources(self) -> list[Any]:
        """What has values and problems of its own."""
        return [*self._receptions(), *([self.transforms] if self.transforms else [])]

    def _problems(self) -> list[Problem]:
        """Each is logged when it comes up, at most once in LOG_PERIOD."""
        found = [p for source in self._sources() for p in source.problems()]
        name, namespace = self.get_name(), self.get_namespace()
        if self.get_node_names_and_namespaces().count((name, namespace)) > 1:
            found.append(("name", WARN, f"another node is called {self.get_fully_qualified_name()} "
                          "too, so topics and parameters of both are mixed; end one, or give it "
                          "another namespace"))
        before, self._present = self._present, {kind for kind, _, _ in found}
        for kind, level, message in found:
            if kind not in before:
                self._log_seldom(kind, level, message)
        return found

    def _hardware_id(self) -> str:
        """The sensor, as its clouds and the namespace name it; tells two sensors apart."""
        parts = self.get_namespace().strip("/"), self.frame_id
        return "/".join(filter(None, parts)) or "lidar_perception"

    def _tick(self) -> None:
        for reception in self._receptions():
            reception.adapt()  # where the middleware has no events that say so
            reception.try_again()
        self.publish_diagnostics()

    def spin(self, executor: Executor) -> None:
        """Work until stop is done."""
        executor.spin_until_future_complete(self.stop)

    def close(self) -> None:
        """Called once before the node is destroyed. InputError where what it holds is lost."""


def decoded(data: bytes, type_name: str) -> Any:
    if type_name in load_typestore().fielddefs:
        return decode(data, type_name)
    return deserialize_message(data, message_class(type_name))


class Subscribed:
    """An input other than clouds."""

    def __init__(self, node: Node, subscribe: Callable[[], Any]):
        self.node, self.subscribe = node, subscribe
        self.subscription: Any = None

    def open(self) -> None:
        self.subscription = self.subscribe()

    def close(self) -> None:
        if self.subscription is not None:
            self.node.destroy_subscription(self.subscription)
        self.subscription = None


def _kind_of(message: str) -> str:
    """The message without its numbers."""
    return re.sub(r"\d[\d.,e+-]*", "0", message)


def _warm_up_type(type_name: str) -> None:
    """rosbags writes its code for a type on first use: do that before the first message."""
    if type_name in load_typestore().fielddefs:
        decode(encode(bag_message(type_name)), type_name)

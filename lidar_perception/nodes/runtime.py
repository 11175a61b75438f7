"""What all nodes share: parameters from a dataclass, QoS, diagnostics, guarded callbacks."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from contextlib import contextmanager
from time import perf_counter
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.task import Future
from std_msgs.msg import Float64

from lidar_perception.param_fields import flatten, new_name, parameter_fields, with_values
from lidar_perception.types import InputError
from lidar_perception.wire.codec import bag_message, decode, encode, typestore
from msg_utils.messages import message_class

CLOUD = "sensor_msgs/msg/PointCloud2"
MARKERS = "visualization_msgs/msg/MarkerArray"

SENSOR_DATA = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=10)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
JUMP_NS = 10**9  # stamps that go back by more than this are a bag that starts again
TYPES = {bool: Parameter.Type.BOOL, int: Parameter.Type.INTEGER, float: Parameter.Type.DOUBLE,
         str: Parameter.Type.STRING}
LISTS = {int: Parameter.Type.INTEGER_ARRAY, float: Parameter.Type.DOUBLE_ARRAY,
         str: Parameter.Type.STRING_ARRAY}


class LidarNode(Node):
    """A node whose callbacks never end it: bad input becomes a diagnostic.

    params is a dataclass of params.py; its fields are declared as ROS parameters, and a change at
    run time goes through the same checks.
    """

    def __init__(self, name: str, params: Any, **options: Any):
        super().__init__(name, **options)
        self.params = self._declare(params)
        self.add_on_set_parameters_callback(self._on_set)
        self.stop = Future()  # done when the node shall end; set from any thread
        self.state = (WARN, "waiting for input")
        self.counts: dict[str, Any] = {"frames": 0, "lost": 0}
        self.last_stamp_ns = 0
        self.times: list[float] = []
        self._outputs: list[Any] = []
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", RELIABLE)
        self._processing_time = self.create_publisher(Float64, "~/debug/processing_time_ms",
                                                      RELIABLE)
        self.create_timer(1.0, self.publish_diagnostics, clock=Clock(
            clock_type=ClockType.STEADY_TIME))

    def _declare(self, params: Any) -> Any:
        declared = {}
        for name in self._parameter_overrides:
            if (new := new_name(name)) in parameter_fields(params):
                raise InputError(f"parameter '{name}' is called '{new}' now; rename it")
        for name, f in parameter_fields(params).items():
            kind = LISTS[f.metadata["item"]] if isinstance(f.default, tuple) else TYPES[
                type(f.default)]
            value = list(f.default) if isinstance(f.default, tuple) else f.default
            # An empty list has no type of its own; declared by type it is "not set".
            declared[name] = self.declare_parameter(name, kind if value == [] else value,
                                                    _descriptor(f, kind)).value
        return with_values(params, {k: v for k, v in declared.items() if v is not None})

    def _on_set(self, changes: list[Parameter]) -> SetParametersResult:
        known = flatten(self.params)
        try:
            self.params = with_values(
                self.params, {c.name: c.value for c in changes if c.name in known})
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def input(self, topic: str, type_name: str, callback: Callable, qos: QoSProfile = SENSOR_DATA):
        """Subscribe to ~/input/TOPIC (or an absolute name). callback gets rosbags' class of the
        message, the one that offline code reads from bags: it views the received bytes, where
        rclpy's own class copies them several times."""
        name = topic if topic.startswith("/") else f"~/input/{topic}"
        _warm_up_type(type_name)

        def guarded(data: bytes) -> None:
            try:
                callback(decode(data, type_name))
            except InputError as error:
                self.report(ERROR, f"{self.resolve_topic_name(name)}: {error}")
            except Exception as error:
                self.get_logger().error(traceback.format_exc())
                self.report(ERROR, f"{self.resolve_topic_name(name)}: {type(error).__name__}: "
                            f"{error}; this is a bug, please report it with the message")

        def lost(event: Any) -> None:
            self.counts["lost"] += event.total_count_change

        return self.create_subscription(
            message_class(type_name), name, guarded, qos, raw=True,
            event_callbacks=SubscriptionEventCallbacks(message_lost=lost),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

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

    def report(self, level: bytes, message: str) -> None:
        """Set the diagnostic state; a change is logged and published at once."""
        if (level, message) != self.state:
            self.state = (level, message)
            if level == OK:  # one line a level: rclpy ties the level to the place of the call
                self.get_logger().info(message)
            elif level == WARN:
                self.get_logger().warning(message)
            else:
                self.get_logger().error(message)
            self.publish_diagnostics()

    @contextmanager
    def frame(self, stamp_ns: int):
        """Around the work on one cloud: counts it, times it, notices that time went back."""
        if stamp_ns < self.last_stamp_ns - JUMP_NS:
            self.get_logger().info("time went back; what waited from before is dropped")
        self.last_stamp_ns = stamp_ns
        begin = perf_counter()
        yield
        elapsed = (perf_counter() - begin) * 1e3
        self._processing_time.publish(Float64(data=elapsed))
        self.times = [*self.times[-99:], elapsed]
        self.counts["frames"] += 1

    def publish_diagnostics(self) -> None:
        level, message = self.state
        values = dict(self.counts, last_stamp_ns=self.last_stamp_ns)
        if self.times:
            values["processing_ms_median"] = f"{np.median(self.times):.1f}"
        for publisher in self._outputs:
            values[f"subscribers of {publisher.topic_name}"] = publisher.get_subscription_count()
        status = DiagnosticStatus(level=level, name=self.get_fully_qualified_name().lstrip("/"),
                                  message=message, hardware_id="lidar_perception",
                                  values=[KeyValue(key=k, value=str(v)) for k, v in values.items()])
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        if rclpy.ok(context=self.context):
            self._diagnostics.publish(array)

    def spin(self, executor: Executor) -> None:
        """Work until stop is done."""
        executor.spin_until_future_complete(self.stop)

    def close(self) -> None:
        """Called once before the node is destroyed."""


def _warm_up_type(type_name: str) -> None:
    """rosbags writes its code for a type on first use: do that before the first message."""
    if type_name in typestore().fielddefs:
        decode(encode(bag_message(type_name)), type_name)


def _descriptor(f: Any, kind: Parameter.Type) -> ParameterDescriptor:
    limits = f.metadata
    unit = f" [{limits['unit']}]" if limits["unit"] else ""
    choices = f"one of {', '.join(limits['choices'])}" if limits["choices"] else ""
    descriptor = ParameterDescriptor(description=limits["doc"] + unit, read_only=limits["fixed"],
                                     type=kind.value, additional_constraints=choices)
    low, high = limits["low"], limits["high"]
    if low is not None or high is not None:
        if kind == Parameter.Type.DOUBLE:
            descriptor.floating_point_range = [FloatingPointRange(
                from_value=float(-1e300 if low is None else low),
                to_value=float(1e300 if high is None else high), step=0.0)]
        elif kind == Parameter.Type.INTEGER:
            descriptor.integer_range = [IntegerRange(
                from_value=-2**62 if low is None else low,
                to_value=2**62 if high is None else high, step=0)]
    return descriptor

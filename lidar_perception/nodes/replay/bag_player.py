"""Node that plays a bag. It publishes the recorded bytes, except that other cloud types become PointCloud2."""

from __future__ import annotations

import importlib.util
import warnings
from collections import deque
from statistics import median
from time import monotonic
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.exceptions import NameValidationException
from rclpy.executors import Executor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from lidar_perception.data.bag import Bag
from lidar_perception.nodes.diagnostics import OK, WARN
from lidar_perception.nodes.interfaces import RELIABLE
from lidar_perception.nodes.replay.pacing import Pace
from lidar_perception.nodes.runtime import LidarNode
from lidar_perception.nodes.transforms import STATIC_QOS
from lidar_perception.params import PlayerParams
from lidar_perception.types import InputError, InputWarning
from lidar_perception.wire.clouds import POINT_CLOUD, decode_cloud, find_cloud_topics
from lidar_perception.wire.codec import encode
from lidar_perception.wire.transforms import TF_MESSAGE
from msg_utils.messages import make_ros_message
from msg_utils.stamps import SECOND_NS, make_time

SERVICE_PERIOD_S = 0.05  # period in which services are handled while the replay is behind schedule
MIN_LOOP_S = 0.1  # minimum duration of one pass through the bag with the parameter loop
ANSWER_POLL_S = 0.2  # polling period while waiting for answers; an answer ends the wait early
UNCOUNTED_SUFFIXES = "_ms", "_3d"  # suffixes of topics whose subscribers the diagnostics do not list


class BagPlayer(LidarNode):
    """Plays a bag once and ends with exit code 0, or plays it in a loop.

    Services (std_srvs/Trigger): ~/pause, ~/resume, and ~/step, which plays up to and including the
    next cloud. The speed is the parameter `rate`; ~/set_rate exists if rosbag2_interfaces is
    installed.
    """

    def __init__(self, **options: Any):
        super().__init__("bag_player", PlayerParams(), **options)
        if not self.params.bag:
            raise InputError("parameter 'bag' is empty; give the folder of a bag")
        with warnings.catch_warnings(record=True, action="always", category=InputWarning) as caught:
            self.bag = Bag(self.params.bag)
        for warning in caught:
            self.get_logger().warning(str(warning.message))
        # Topics whose clouds are converted to PointCloud2.
        self.converted_topics = {t for t in find_cloud_topics(self.bag.topics) if self.bag.topics[t] != POINT_CLOUD}
        self.types = {
            t: POINT_CLOUD if t in self.converted_topics else type_name for t, type_name in self.bag.topics.items()
        }
        # True if clouds wait for the answers to earlier clouds.
        self.follows = bool(self.params.follow and self.params.ahead)
        self.names = self._select_topics()
        self.publishers_by_topic = {t: p for t in self.names if (p := self._make_publisher(t))}
        if not self.publishers_by_topic:
            raise InputError(
                f"{self.params.bag}: nothing to play; no playable topic among "
                f"{', '.join(self.bag.topics) or 'an empty bag'}"
            )
        self.awaited_counts = self._parse_wait_for()
        self.diagnostic_values: dict[str, dict[str, str]] = {}  # node -> key -> value
        self.start_ns = self.bag.start_ns + int(self.params.start_offset * SECOND_NS)
        if self.start_ns > self.bag.end_ns:
            raise InputError(
                f"start_offset {self.params.start_offset:g} s is past the end of "
                f"{self.params.bag}, which is "
                f"{(self.bag.end_ns - self.bag.start_ns) / SECOND_NS:.1f} s long"
            )
        self.stop_ns = self.start_ns + int(self.params.duration * SECOND_NS) if self.params.duration else None
        self.is_paused = self.params.start_paused
        self.warned_topics: set[str] = set()  # topics with skipped messages
        self.steps = 0  # requested steps that are not played yet
        self.step_topic = max(
            self.publishers_by_topic, key=lambda t: (self.types[t] == POINT_CLOUD, self.bag.counts[t])
        )
        self.now_ns, self.last_advance = self.start_ns, monotonic()  # bag time, and when it was last advanced
        self.pace = Pace(self, self.params.follow, self.params.ahead, self.params.follow_timeout)
        self.clock = self.params.clock_hz and self.create_publisher(Clock, "/clock", RELIABLE)
        self.next_clock, self.last_service = 0.0, 0.0  # monotonic times
        for name, action in (("pause", self._pause), ("resume", self._resume), ("step", self._step)):
            self.create_service(Trigger, f"~/{name}", action)
        if importlib.util.find_spec("rosbag2_interfaces"):
            from rosbag2_interfaces.srv import SetRate

            self.create_service(SetRate, "~/set_rate", self._set_rate)

    def _select_topics(self) -> dict[str, str]:
        """Return {topic of the bag: topic on which it is played}."""
        for topic in self.params.topics:
            self.bag.require(topic)
        names = {t: t for t in (self.params.topics or self.bag.topics)}
        for rule in self.params.remap:
            old, separator, new = rule.partition(":=")
            if not separator or old not in names:
                raise InputError(f"remap '{rule}' must be OLD:=NEW with one of the topics {', '.join(names)}")
            names[old] = new
        full_names = {topic: self._expand_name(name, f"the topic {topic}") for topic, name in names.items()}
        type_by_name: dict[str, str] = {}
        for topic, name in full_names.items():
            if type_by_name.setdefault(name, self.types[topic]) != self.types[topic]:
                raise InputError(
                    f"{name} would have the types {type_by_name[name]} and {self.types[topic]}; "
                    f"remap {topic} to another name"
                )
        return full_names

    def _expand_name(self, name: str, source: str) -> str:
        """Return the full name of a topic; relative names are in the namespace of the node."""
        try:
            return self.resolve_topic_name(name, only_expand=True)
        except (ValueError, RuntimeError, NameValidationException) as error:
            reason = " ".join(str(error).split())
            raise InputError(f"{source}: '{name}' is not a valid topic name ({reason})") from None

    def _parse_wait_for(self) -> dict[str, int]:
        """Return {topic: number of subscribers to wait for}."""
        counts = {}
        cloud_topics = [self.names[t] for t in find_cloud_topics(self.bag.topics) if t in self.names]
        for rule in self.params.wait_for or cloud_topics:
            name, _, count = rule.partition(":=")
            if count and not count.isdecimal():
                raise InputError(f"wait_for '{rule}' must be TOPIC or TOPIC:=COUNT")
            counts[self._expand_name(name, "wait_for")] = int(count or 1)
        return counts

    def _make_publisher(self, topic: str) -> Any:
        type_name = self.types[topic]
        try:
            return self.outputs.advertise(
                self.names[topic],
                type_name,
                _make_qos(self.bag.find_qos(topic), self._count_latched(topic), lossless=self.follows),
            ).publisher
        except (ModuleNotFoundError, AttributeError):
            self.get_logger().warning(f"{topic} is not played: {type_name} is not installed on this machine")
            return None

    def _is_latched(self, topic: str) -> bool:
        return any(q.durability.name == "TRANSIENT_LOCAL" for q in self.bag.find_qos(topic))

    def _count_latched(self, topic: str) -> int:
        """Return how many of the last messages of a latched topic are valid: one, or for transforms, which several
        nodes publish, more."""
        return STATIC_QOS.depth if self.bag.topics[topic] == TF_MESSAGE else 1

    def spin(self, executor: Executor) -> None:
        """Play the bag, and handle services and parameters between messages."""
        self.serve = executor.spin_once
        self._wait_for_subscribers()
        self.diagnostics.report(OK, f"playing {self.params.bag}")
        while not self.stop.done():
            begin = monotonic()
            self._play_once()
            if not self.params.loop:
                break
            while not self.stop.done() and (remaining_s := begin + MIN_LOOP_S - monotonic()) > 0:
                self.serve(timeout_sec=remaining_s)
        self.pace.wait_for_answers(self._serve_answers, self.stop.done)
        self._count_pace()
        self.diagnostics.report(OK, "stopped" if self.stop.done() else "reached the end of the bag")
        self._wait_until_delivered()

    def _wait_for_subscribers(self) -> None:
        diagnostics = self.awaited_counts and self.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_status, RELIABLE
        )
        self._wait_until_connected()
        if diagnostics:
            self.destroy_subscription(diagnostics)

    def _on_status(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            self.diagnostic_values[f"/{status.name}"] = {v.key: v.value for v in status.values}

    def _wait_until_connected(self) -> None:
        give_up = monotonic() + self.params.wait_timeout
        while not self.stop.done():
            missing_topics = [t for t, count in self.awaited_counts.items() if self._count_subscribers(t) < count]
            missing_topics += [t for t in self.params.follow if not self.count_publishers(t)]
            if not missing_topics:
                return
            if monotonic() > give_up:
                self.diagnostics.report(
                    WARN,
                    f"too few subscribers of {', '.join(missing_topics)} (or publishers of "
                    f"topics in follow) after {self.params.wait_timeout:g} s; playing "
                    "anyway",
                )
                return
            self._publish_clock()  # the awaited nodes may be waiting for the clock
            self.serve(timeout_sec=0.02)

    def _count_subscribers(self, topic: str) -> int:
        """Count the subscribers of a topic.

        These are the matched subscribers for topics of this node, and of nodes of this package,
        which report them in their diagnostics. For other topics, they are the discovered ones.
        """
        name = self.resolve_topic_name(topic)
        own_publishers = [p for p in self.publishers_by_topic.values() if p.topic_name == name]
        if own_publishers:
            return own_publishers[0].get_subscription_count()
        node = name.rsplit("/", 2)[0]
        if name.endswith(UNCOUNTED_SUFFIXES) or not self.count_publishers(f"{node}/debug/processing_time_ms"):
            return self.count_subscribers(name)  # another package publishes the topic
        values = self.diagnostic_values.get(node, {})  # includes subscribers inside the node's process
        return int(values.get(f"subscribers of {name}", 0))

    def _wait_until_delivered(self) -> None:
        from rclpy.duration import Duration

        for publisher in (*self.publishers_by_topic.values(), self.diagnostics.publisher):
            if not self.stop.done():
                publisher.wait_for_all_acked(Duration(seconds=2))

    def _play_once(self) -> None:
        self._publish_latched()
        self.now_ns, self.last_advance = self.start_ns, monotonic()
        for topic, stamp, data in self.bag.raw_messages(self.publishers_by_topic, self.start_ns, self.stop_ns):
            if not self._wait_until(stamp, topic):
                return
            if (message := self._convert(topic, data)) is None:
                continue
            if topic == self.step_topic:
                self._follow(message)
            self.publishers_by_topic[topic].publish(message)
            self.diagnostics.counts["frames"] += topic == self.step_topic
            self.diagnostics.last_stamp_ns = stamp

    def _convert(self, topic: str, data: bytes) -> bytes | None:
        """Return the CDR to publish for a message, or None for a cloud that cannot be converted.

        The first such cloud of a topic is reported with a warning.
        """
        if topic not in self.converted_topics:
            return data
        try:
            return encode(decode_cloud(data, self.bag.topics[topic]))
        except InputError as error:
            if topic not in self.warned_topics:
                self.get_logger().warning(f"messages on {topic} are skipped: {error}")
            self.warned_topics.add(topic)
            self.diagnostics.counts["left_out"] = self.diagnostics.counts.get("left_out", 0) + 1
            return None

    def _follow(self, cloud: bytes) -> None:
        """Wait until the graph has caught up; meanwhile the bag time stands still."""
        if self.follows:
            self._advance()
            self.pace.wait_for_room(self._serve_answers, self.stop.done)
            self.last_advance = monotonic()
        self.pace.add_cloud(cloud)
        self._count_pace()

    def _serve_answers(self) -> None:
        self.serve(timeout_sec=ANSWER_POLL_S)

    def _count_pace(self) -> None:
        if latencies := sorted(self.pace.latencies_ms):
            self.diagnostics.counts.update(
                latency_ms_median=f"{median(latencies):.1f}",
                latency_ms_p95=f"{latencies[int(0.95 * (len(latencies) - 1))]:.1f}",
            )
        if self.follows:
            duration = max((self.now_ns - self.start_ns) / SECOND_NS / self.params.rate, 1e-9)
            self.diagnostics.counts.update(
                unanswered=self.pace.missing_answers,
                held_s=f"{self.pace.held_s:.2f}",
                slower=f"{(duration + self.pace.held_s) / duration:.2f}",
            )

    def _publish_latched(self) -> None:
        """Publish the latched messages that are valid at the start of the replay."""
        earlier_messages: dict[str, deque[bytes]] = {}
        latched_topics = {t for t in self.publishers_by_topic if self._is_latched(t)}
        if self.start_ns > self.bag.start_ns and latched_topics:
            for topic, _, data in self.bag.raw_messages(latched_topics, None, self.start_ns):
                earlier_messages.setdefault(topic, deque(maxlen=self._count_latched(topic))).append(data)
        for topic, messages in earlier_messages.items():
            for data in messages:
                if (message := self._convert(topic, data)) is not None:
                    self.publishers_by_topic[topic].publish(message)

    def _wait_until(self, stamp: int, topic: str) -> bool:
        """Spin until the bag time reaches `stamp`; return False if the node should end."""
        while not self.stop.done():
            self._advance()
            if self.steps and self.is_paused:
                self.now_ns = stamp
                self.steps -= topic == self.step_topic
                return True
            remaining_s = (stamp - self.now_ns) / SECOND_NS / self.params.rate
            is_late = remaining_s <= 0 and not self.is_paused
            if is_late and monotonic() - self.last_service < SERVICE_PERIOD_S:
                return True  # otherwise handle service calls first, however late the replay is
            wait = 0.05 if self.is_paused else min(max(remaining_s, 0.0), 0.05)
            if self.clock:
                wait = min(wait, max(self.next_clock - monotonic(), 0.0))
            self.last_service = monotonic()
            self.serve(timeout_sec=wait)
        return False

    def _advance(self) -> None:
        """Advance the bag time by the elapsed time, multiplied by the rate."""
        now = monotonic()
        if not self.is_paused:
            self.now_ns += int((now - self.last_advance) * self.params.rate * SECOND_NS)
        self.last_advance = now
        self._publish_clock()

    def _publish_clock(self) -> None:
        now = monotonic()
        if self.clock and now >= self.next_clock:
            self.next_clock = max(self.next_clock + 1 / self.params.clock_hz, now)
            self.clock.publish(Clock(clock=make_time(self.now_ns, make_ros_message)))

    def _pause(self, _: Any, response: Any) -> Any:
        self._advance()
        self.is_paused = True
        return _fill_response(response, "paused")

    def _resume(self, _: Any, response: Any) -> Any:
        self._advance()
        self.is_paused = False
        return _fill_response(response, "playing")

    def _step(self, _: Any, response: Any) -> Any:
        if not self.is_paused:
            return _fill_response(response, "pause first", success=False)
        self.steps += 1
        return _fill_response(response, f"next message of {self.step_topic}")

    def _set_rate(self, request: Any, response: Any) -> Any:
        from rclpy.parameter import Parameter

        self._advance()
        result = self.set_parameters([Parameter("rate", value=float(request.rate))])[0]
        response.success = result.successful
        return response

    def close(self) -> None:
        self.bag.close()


def _fill_response(response: Any, message: str, success: bool = True) -> Any:
    response.success, response.message = success, message
    return response


def _make_qos(profiles: list, latched_count: int, lossless: bool) -> QoSProfile:
    """Return a publisher profile that is compatible with the same subscribers as the recorded publishers.

    Args:
        profiles: recorded profiles of the publishers; if empty, the result is reliable and volatile.
        latched_count: number of messages of a latched topic that a late subscriber gets.
        lossless: reliable even if the recorded publishers were not.
    """
    if not profiles:
        return RELIABLE
    best_effort = all(q.reliability.name == "BEST_EFFORT" for q in profiles) and not lossless
    is_latched = any(q.durability.name == "TRANSIENT_LOCAL" for q in profiles)
    return QoSProfile(
        depth=max(latched_count * is_latched, 10, *(q.depth for q in profiles)),
        reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if is_latched else DurabilityPolicy.VOLATILE,
    )

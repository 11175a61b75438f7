"""Replays a bag: CDR bytes from the file to DDS; only clouds in other messages are decoded."""

from __future__ import annotations

import importlib.util
import warnings
from collections import deque
from time import monotonic
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.exceptions import NameValidationException
from rclpy.executors import Executor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from lidar_perception.data.bag import Bag
from lidar_perception.nodes.replay.pacing import Pace
from lidar_perception.nodes.runtime import OK, RELIABLE, WARN, LidarNode
from lidar_perception.nodes.transforms import STATIC_QOS
from lidar_perception.params import PlayerParams
from lidar_perception.types import InputError, InputWarning
from lidar_perception.wire.clouds import POINT_CLOUD, decode_cloud, find_cloud_topics
from lidar_perception.wire.codec import encode
from lidar_perception.wire.transforms import TF_MESSAGE
from msg_utils.messages import ros_message
from msg_utils.stamps import SECOND, time_message

SERVED = 0.05       # seconds between looks for services and parameters, while messages are late
SHORTEST_LOOP = 0.1  # seconds
UNCOUNTED = "_ms", "_3d"  # ends of topics of whose subscribers nodes do not tell


class BagPlayer(LidarNode):
    """Ends with exit code 0 when the bag is played, unless it loops.

    Services (std_srvs/Trigger): ~/pause, ~/resume, ~/step (one message of the busiest topic and
    what comes before it). The speed is the parameter `rate`; ~/set_rate exists too where
    rosbag2_interfaces is installed.
    """

    def __init__(self, **options: Any):
        super().__init__("bag_player", PlayerParams(), **options)
        if not self.params.bag:
            raise InputError("parameter 'bag' is empty; give the folder of a bag")
        with warnings.catch_warnings(record=True, action="always", category=InputWarning) as wrong:
            self.bag = Bag(self.params.bag)
        for warning in wrong:
            self.get_logger().warning(str(warning.message))
        # Topics with clouds that are played as PointCloud2
        self.converted = {t for t in find_cloud_topics(self.bag.topics)
                          if self.bag.topics[t] != POINT_CLOUD}
        self.kinds = {t: POINT_CLOUD if t in self.converted else kind
                      for t, kind in self.bag.topics.items()}
        self.names = self._chosen_topics()
        self.publishers_by_topic = {t: p for t in self.names if (p := self._publisher(t))}
        if not self.publishers_by_topic:
            raise InputError(f"{self.params.bag}: nothing to play; no topic is left of "
                             f"{', '.join(self.bag.topics) or 'an empty bag'}")
        self.wanted = self._wanted()
        self.told: dict[str, dict[str, str]] = {}  # node -> values of its diagnostics
        self.start_ns = self.bag.start_ns + int(self.params.start_offset * SECOND)
        if self.start_ns > self.bag.end_ns:
            raise InputError(f"start_offset {self.params.start_offset:g} s is after the end of "
                             f"{self.params.bag}, which has "
                             f"{(self.bag.end_ns - self.bag.start_ns) / SECOND:.1f} s")
        self.stop_ns = (self.start_ns + int(self.params.duration * SECOND)
                        if self.params.duration else None)
        self.paused = self.params.start_paused
        self.warned: set[str] = set()  # topics with messages that are left out
        self.steps = 0
        self.step_topic = max(self.publishers_by_topic, key=lambda t: (
            self.kinds[t] == POINT_CLOUD, self.bag.counts[t]))
        self.now_ns, self.anchor = self.start_ns, monotonic()
        self.pace = Pace(self, self.params.follow, self.params.ahead, self.params.follow_timeout)
        self.clock = self.params.clock_hz and self.create_publisher(Clock, "/clock", RELIABLE)
        self.next_clock, self.served = 0.0, 0.0  # monotonic
        for name, action in (("pause", self._pause), ("resume", self._resume),
                             ("step", self._step)):
            self.create_service(Trigger, f"~/{name}", action)
        if importlib.util.find_spec("rosbag2_interfaces"):
            from rosbag2_interfaces.srv import SetRate
            self.create_service(SetRate, "~/set_rate", self._set_rate)

    def _chosen_topics(self) -> dict[str, str]:
        """Topic in the bag -> topic as played."""
        for topic in self.params.topics:
            self.bag.require(topic)
        names = {t: t for t in (self.params.topics or self.bag.topics)}
        for rule in self.params.remap:
            old, separator, new = rule.partition(":=")
            if not separator or old not in names:
                raise InputError(f"remap '{rule}' must be OLD:=NEW with one of the topics "
                                 f"{', '.join(names)}")
            names[old] = new
        expanded = {topic: self._expanded(name, f"the topic {topic}")
                    for topic, name in names.items()}
        kinds: dict[str, str] = {}
        for topic, name in expanded.items():
            if kinds.setdefault(name, self.kinds[topic]) != self.kinds[topic]:
                raise InputError(f"{name} would have the types {kinds[name]} and "
                                 f"{self.kinds[topic]}; remap {topic} to another name")
        return expanded

    def _expanded(self, name: str, what: str) -> str:
        """A name of a topic from the root on; relative ones are in the node's namespace."""
        try:
            return self.resolve_topic_name(name, only_expand=True)
        except (ValueError, RuntimeError, NameValidationException) as error:
            reason = " ".join(str(error).split())
            raise InputError(f"{what}: '{name}' is no name of a topic ({reason})") from None

    def _wanted(self) -> dict[str, int]:
        """Topic -> how many subscribers are waited for."""
        wanted = {}
        own = [self.names[t] for t in find_cloud_topics(self.bag.topics) if t in self.names]
        for rule in self.params.wait_for or own:
            name, _, count = rule.partition(":=")
            if count and not count.isdecimal():
                raise InputError(f"wait_for '{rule}' must be TOPIC or TOPIC:=COUNT")
            wanted[self._expanded(name, "wait_for")] = int(count or 1)
        return wanted

    def _publisher(self, topic: str) -> Any:
        kind = self.kinds[topic]
        try:
            return self.output(self.names[topic], kind, _qos(
                self.bag.qos(topic), self._held(topic), lossless=bool(self.params.follow)))
        except (ModuleNotFoundError, AttributeError):
            self.get_logger().warning(f"{topic} is not played: {kind} is not installed here")
            return None

    def _latched(self, topic: str) -> bool:
        return any(q.durability.name == "TRANSIENT_LOCAL" for q in self.bag.qos(topic))

    def _held(self, topic: str) -> int:
        """How many messages of a latched topic hold at a time: the last; but of transforms all that
        who listens to TF takes, as each node sends its own and none takes back another's."""
        return STATIC_QOS.depth if self.bag.topics[topic] == TF_MESSAGE else 1

    def spin(self, executor: Executor) -> None:
        """Play; services and parameters are served between messages."""
        self.serve = executor.spin_once
        self._wait_for_subscribers()
        self.report(OK, f"playing {self.params.bag}")
        while not self.stop.done():
            begun = monotonic()
            self._play_once()
            if not self.params.loop:
                break
            while not self.stop.done() and (left := begun + SHORTEST_LOOP - monotonic()) > 0:
                self.serve(timeout_sec=left)
        self._count_pace()
        self.report(OK, "stopped" if self.stop.done() else "the bag is played")
        self._wait_until_delivered()

    def _wait_for_subscribers(self) -> None:
        diagnostics = self.wanted and self.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_status, RELIABLE)
        self._wait_until_heard()
        if diagnostics:
            self.destroy_subscription(diagnostics)

    def _on_status(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            self.told[f"/{status.name}"] = {v.key: v.value for v in status.values}

    def _wait_until_heard(self) -> None:
        give_up = monotonic() + self.params.wait_timeout
        while not self.stop.done():
            missing = [t for t, count in self.wanted.items() if self._subscribers(t) < count]
            missing += [t for t in self.params.follow if not self.count_publishers(t)]
            if not missing:
                return
            if monotonic() > give_up:
                self.report(WARN, f"too few subscribers of {', '.join(missing)} (or publishers, of "
                            f"what is followed) after {self.params.wait_timeout:g} s; playing "
                            "anyway")
                return
            self._tell_time()  # who waits for the time may be who is waited for
            self.serve(timeout_sec=0.02)

    def _subscribers(self, topic: str) -> int:
        """Of a topic that is played, or of a node of ours that says so in its diagnostics, those
        that are matched; else those that are known of."""
        resolved = self.resolve_topic_name(topic)
        played = [p for p in self.publishers_by_topic.values() if p.topic_name == resolved]
        if played:
            return played[0].get_subscription_count()
        known, node = self.count_subscribers(resolved), resolved.rsplit("/", 2)[0]
        if resolved.endswith(UNCOUNTED) or not self.count_publishers(
                f"{node}/debug/processing_time_ms"):
            return known  # no output of a node of ours
        return min(known, int(self.told.get(node, {}).get(f"subscribers of {resolved}", 0)))

    def _wait_until_delivered(self) -> None:
        from rclpy.duration import Duration
        for publisher in (*self.publishers_by_topic.values(), self._diagnostics):
            if not self.stop.done():
                publisher.wait_for_all_acked(Duration(seconds=2))

    def _play_once(self) -> None:
        self._publish_latched()
        self.now_ns, self.anchor = self.start_ns, monotonic()
        for topic, stamp, data in self.bag.raw_messages(self.publishers_by_topic, self.start_ns,
                                               self.stop_ns):
            if not self._wait_until(stamp, topic):
                return
            if (played := self._as_played(topic, data)) is None:
                continue
            if topic == self.step_topic:
                self._follow(played)
            self.publishers_by_topic[topic].publish(played)
            self.counts["frames"] += topic == self.step_topic
            self.last_stamp_ns = stamp

    def _as_played(self, topic: str, data: bytes) -> bytes | None:
        """Return the CDR of a message as it is played; None, with a warning for the first one of a
        topic, for a cloud that cannot be converted."""
        if topic not in self.converted:
            return data
        try:
            return encode(decode_cloud(data, self.bag.topics[topic]))
        except InputError as error:
            if topic not in self.warned:
                self.get_logger().warning(f"messages on {topic} are left out: {error}")
            self.warned.add(topic)
            self.counts["left_out"] = self.counts.get("left_out", 0) + 1
            return None

    def _follow(self, cloud: bytes) -> None:
        """Wait until the graph keeps up; the bag's time stands still meanwhile."""
        if self.params.follow:
            self._advance()
            self.pace.room(lambda: self.serve(timeout_sec=0.05), self.stop.done)
            self.pace.sent(cloud)
            self.anchor = monotonic()
            self._count_pace()

    def _count_pace(self) -> None:
        if self.params.follow:
            played = max((self.now_ns - self.start_ns) / SECOND / self.params.rate, 1e-9)
            self.counts.update(unanswered=self.pace.unanswered, held_s=f"{self.pace.held:.2f}",
                               slower=f"{(played + self.pace.held) / played:.2f}")

    def _publish_latched(self) -> None:
        """What holds of each latched topic at the start, so that none is missed."""
        before: dict[str, deque[bytes]] = {}
        latched = {t for t in self.publishers_by_topic if self._latched(t)}
        if self.start_ns > self.bag.start_ns and latched:
            for topic, _, data in self.bag.raw_messages(latched, None, self.start_ns):
                before.setdefault(topic, deque(maxlen=self._held(topic))).append(data)
        for topic, messages in before.items():
            for data in messages:
                if (played := self._as_played(topic, data)) is not None:
                    self.publishers_by_topic[topic].publish(played)

    def _wait_until(self, stamp: int, topic: str) -> bool:
        """Serve until it is time for stamp; False when the node shall end."""
        while not self.stop.done():
            self._advance()
            if self.steps and self.paused:
                self.now_ns = stamp
                self.steps -= topic == self.step_topic
                return True
            behind = (stamp - self.now_ns) / SECOND / self.params.rate
            late = behind <= 0 and not self.paused
            if late and monotonic() - self.served < SERVED:
                return True  # else services are heard first, however far behind it is
            wait = 0.05 if self.paused else min(max(behind, 0.0), 0.05)
            if self.clock:
                wait = min(wait, max(self.next_clock - monotonic(), 0.0))
            self.served = monotonic()
            self.serve(timeout_sec=wait)
        return False

    def _advance(self) -> None:
        """Move the bag's time by the time that went by, at the present rate."""
        now = monotonic()
        if not self.paused:
            self.now_ns += int((now - self.anchor) * self.params.rate * SECOND)
        self.anchor = now
        self._tell_time()

    def _tell_time(self) -> None:
        now = monotonic()
        if self.clock and now >= self.next_clock:
            self.next_clock = max(self.next_clock + 1 / self.params.clock_hz, now)
            self.clock.publish(Clock(clock=time_message(self.now_ns, ros_message)))

    def _pause(self, _: Any, response: Any) -> Any:
        self._advance()
        self.paused = True
        return _done(response, "paused")

    def _resume(self, _: Any, response: Any) -> Any:
        self._advance()
        self.paused = False
        return _done(response, "playing")

    def _step(self, _: Any, response: Any) -> Any:
        if not self.paused:
            return _done(response, "pause first", success=False)
        self.steps += 1
        return _done(response, f"next message of {self.step_topic}")

    def _set_rate(self, request: Any, response: Any) -> Any:
        from rclpy.parameter import Parameter
        self._advance()
        result = self.set_parameters([Parameter("rate", value=float(request.rate))])[0]
        response.success = result.successful
        return response

    def close(self) -> None:
        self.bag.close()


def _done(response: Any, message: str, success: bool = True) -> Any:
    response.success, response.message = success, message
    return response


def _qos(profiles: list, held: int, lossless: bool) -> QoSProfile:
    """The profile that offers what any publisher did when the topic was recorded; what they leave
    open is reliable and volatile. held: messages that a late subscriber gets of a latched topic, at
    least ten. lossless: reliable."""
    if not profiles:
        return RELIABLE
    best_effort = all(q.reliability.name == "BEST_EFFORT" for q in profiles) and not lossless
    latched = any(q.durability.name == "TRANSIENT_LOCAL" for q in profiles)
    return QoSProfile(
        depth=max(held * latched, 10, *(q.depth for q in profiles)),
        reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE)

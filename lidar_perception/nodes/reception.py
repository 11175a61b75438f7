"""Subscriptions to clouds that adapt to the publishers' QoS and count every cloud."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from importlib.resources import files
from time import monotonic
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from lidar_perception.nodes.arrivals import DEPTH, WINDOW, Arrivals
from lidar_perception.nodes.diagnostics import ERROR, STALE, WARN, Problem
from lidar_perception.nodes.links import Links, Output, find_only_output
from lidar_perception.nodes.rclpy_compat import InvalidHandle, get_parameter_overrides, take_messages
from lidar_perception.nodes.shared_memory import SOCKET_BUFFER, read_socket_buffer_size
from lidar_perception.params import ReceptionParams

BEST_EFFORT, RELIABLE = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
MAX_HOLD_S = 1.0  # time during which newer clouds do not replace a waiting one
RETRY_PERIOD_S = 5.0  # pause before waiting again after a timeout
RETRY_DURATION_S = 0.3  # duration of the renewed wait
# Numbers of missed periods after which the state becomes ERROR and STALE.
SILENT_PERIODS, STALE_PERIODS = 3.0, 6.0
# Kind of publisher -> (hint if no clouds arrive, hint if too few arrive).
HINTS = {
    "sensor": ("is the sensor{} connected and running?", "is the sensor{} overloaded?"),
    "detector": (
        "is the detector{} running and receiving clouds?",
        "is the detector{} overloaded, or is its input slower?",
    ),
    "node": ("is the node{} running and receiving clouds?", "is the node{} overloaded, or is its input slower?"),
    "player": ("is the player{} paused, or at the end of its bag?", "is the player{} playing at a lower rate?"),
}
FASTDDS_PROFILE = files("lidar_perception.nodes") / "fastdds.xml"


class Reception:
    """A subscription to clouds, or to arrays made from clouds.

    It is RELIABLE if all publishers offer that, because a best-effort subscriber receives less than
    half of the 2 MB clouds of a typical driver. It becomes BEST_EFFORT as soon as one publisher
    offers only that, because those clouds would not arrive otherwise. qos_overrides take
    precedence.

    If the only publisher of the topic is a node of the same process, its messages arrive through a
    link instead of a subscription, see links.py.

    Args:
        node: the node that subscribes, a LidarNode or a plain node, which has no links.
        kind: class of the message.
        name: name of the topic.
        deliver: called with (cloud, may_wait) for each of the newest input.queue clouds; the cloud
            is CDR, or a message from a link. Returns a description of the data that the cloud still
            needs, or None. A cloud that may wait (up to input.max_wait seconds) and needs data is
            delivered again at retry().
        params: returns the current parameters of the group input.
        what: noun for one message in diagnostics.
    """

    def __init__(
        self,
        node: Any,
        kind: type,
        name: str,
        deliver: Callable[[Any, bool], str | None],
        params: Callable[[], ReceptionParams],
        what: str = "cloud",
    ):
        self.node, self.kind, self.deliver, self.params = node, kind, deliver, params
        self.links: Links | None = getattr(node, "links", None)
        self.what = what
        self.topic = node.resolve_topic_name(name)
        self.has_fixed_reliability = f"qos_overrides.{self.topic}.subscription.reliability" in get_parameter_overrides(
            node
        )
        self.reliability = BEST_EFFORT if params().reliability == "best_effort" else RELIABLE
        self.waiting: deque[Any] = deque()
        self.linked_messages: deque[tuple[Any, dict]] = deque()  # (message, info) from a link, see _receive
        self.deliver_trigger = node.create_guard_condition(self._deliver_one)
        self.adapt_trigger = node.create_guard_condition(self.adapt)
        self.link_trigger = node.create_guard_condition(self._take_linked)
        self.last_time: float | None = None  # monotonic time of the last cloud
        self.missing_input: str | None = None  # data that the oldest waiting or the last cloud needs
        self.missing_since: float | None = None  # monotonic time when that data began to be missing
        self.waiting_since: float | None = None  # monotonic time of arrival of the oldest waiting cloud
        self.output: Output | None = None  # in-process source of the topic, used instead of a subscription
        self.subscription: Any = None
        self.last_publishers: list[Any] = []  # most recent non-empty list of publishers
        self.arrivals = Arrivals()

    @property
    def is_open(self) -> bool:
        return self.subscription is not None or self.output is not None

    def open(self) -> None:
        """Start to receive clouds."""
        if self.links is not None:
            self.links.watch(self.topic, self._on_link_change)
        self._connect()
        self.adapt()

    def close(self) -> None:
        """Stop receiving clouds. Waiting clouds are dropped; later ones do not count as lost."""
        if self.links is not None:
            self.links.unwatch(self.topic, self._on_link_change)
        self._disconnect()
        self.last_time = None
        self.missing_input = self.missing_since = self.waiting_since = None
        self.arrivals.record_interruption(len(self.waiting))
        self.waiting.clear()

    def _connect(self) -> None:
        """Link to an output of this process, or subscribe."""
        self.output = find_only_output(self.node, self.links, self.topic)
        if self.output is None or self.links is None:
            self._subscribe()
        else:
            self.arrivals.depth = max(DEPTH, self.params().queue)
            self.linked_messages = deque(maxlen=self.arrivals.depth)
            self.links.connect(self.output, self._receive)

    def _disconnect(self) -> None:
        if self.output is not None and self.links is not None:
            self.links.disconnect(self.output, self._receive)
            self.linked_messages.clear()
        if self.subscription is not None:
            self.node.destroy_subscription(self.subscription)
        self.output = self.subscription = None

    def _subscribe(self) -> None:
        """Subscribe with a queue in the middleware for clouds that arrive during work."""
        kinds = [QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH]
        events = SubscriptionEventCallbacks(
            matched=lambda _: self.adapt_trigger.trigger(), incompatible_qos=lambda _: self.adapt_trigger.trigger()
        )
        on_message: Any = self._on_message  # rclpy's type annotation lacks the message info
        profile = QoSProfile(depth=max(DEPTH, self.params().queue), reliability=self.reliability)
        self.subscription = self.node.create_subscription(
            self.kind,
            self.topic,
            on_message,
            profile,
            raw=True,
            event_callbacks=events,
            qos_overriding_options=QoSOverridingOptions(
                [*kinds, QoSPolicyKind.RELIABILITY] if self.has_fixed_reliability else kinds
            ),
        )
        self.arrivals.depth = self.subscription.qos_profile.depth

    def list_publishers(self) -> list[Any]:
        """Return the endpoint infos of all publishers of the topic."""
        return self.node.get_publishers_info_by_topic(self.topic)

    def adapt(self) -> None:
        """Reconnect if the publishers, or the reliability that they offer, have changed."""
        if not self.is_open:
            return
        if find_only_output(self.node, self.links, self.topic) is not self.output:
            self._disconnect()
            self._connect()
            self.arrivals.record_interruption(0)
            self.node.get_logger().info(f"reconnected to {self.topic} ({self._describe_reliability()})")
        if self.output is not None:
            self.last_publishers = self.list_publishers() or self.last_publishers
            return
        setting, publishers = self.params().reliability, self.list_publishers()
        self.last_publishers = publishers or self.last_publishers
        offers = {info.qos_profile.reliability for info in publishers}
        if setting == "auto" and offers:
            reliability = RELIABLE if offers == {RELIABLE} else BEST_EFFORT
        else:
            reliability = {"reliable": RELIABLE, "best_effort": BEST_EFFORT}.get(setting, self.reliability)
        if self.has_fixed_reliability or reliability == self.reliability:
            return
        self.reliability = reliability
        self.node.destroy_subscription(self.subscription)
        self._subscribe()
        self.node.get_logger().info(f"reconnected to {self.topic} ({self._describe_reliability()})")

    def _describe_reliability(self) -> str:
        if self.output is not None:
            return "in this process"
        return self.subscription.qos_profile.reliability.name.lower().replace("_", " ")

    def _on_message(self, data: bytes, info: dict) -> None:
        """Take all messages from the middleware, which would drop some of them without counting."""
        messages = [(data, info), *take_messages(self.subscription, self.kind)]
        self._accept(messages, has_one_publisher=len(self.list_publishers()) < 2)

    def _receive(self, message: Any, info: dict) -> None:
        """Queue a message of a link; called in the thread of its publisher."""
        self.linked_messages.append((message, info))
        _trigger(self.link_trigger)

    def _on_link_change(self) -> None:
        _trigger(self.adapt_trigger)

    def _take_linked(self) -> None:
        if messages := [self.linked_messages.popleft() for _ in range(len(self.linked_messages))]:
            self._accept(messages, has_one_publisher=True)

    def _accept(self, messages: list[tuple[Any, dict]], has_one_publisher: bool) -> None:
        """Count the messages (message, info), keep the newest ones and deliver the oldest of these."""
        self.waiting.extend(message for message, _ in messages)
        # Newer clouds do not replace one that has waited for its pose only briefly. Otherwise no
        # cloud would ever be processed if poses arrive later than the next cloud.
        is_held = self.waiting_since is not None and monotonic() - self.waiting_since < MAX_HOLD_S
        held_clouds = [self.waiting.popleft()] if is_held else []
        dropped = max(0, len(self.waiting) - self.params().queue)
        for _ in range(dropped):
            self.waiting.popleft()
            self.waiting_since = self.waiting_since if is_held else None
        self.waiting.extendleft(held_clouds)
        self.arrivals.add([info for _, info in messages], dropped, has_one_publisher)
        self._deliver_one()

    def _deliver_one(self) -> None:
        if not self.waiting:
            return
        since = self.missing_since
        may_wait = since is None or self._may_wait(monotonic() - since)
        self.missing_input = self.deliver(self.waiting[0], may_wait)
        self.last_time = monotonic()  # set after the work, so that processing time does not count as silence
        self.missing_since = None if self.missing_input is None else since or self.last_time
        if since and self.missing_input is None:
            self.arrivals.reset_window()
        if self.missing_input is not None and may_wait:
            self.waiting_since = self.waiting_since or self.last_time
            return
        self.waiting.popleft()
        self.waiting_since = None
        if self.waiting:
            self.deliver_trigger.trigger()

    def _may_wait(self, elapsed: float) -> bool:
        """Return True if a cloud may wait for its input.

        After max_wait, clouds wait only from time to time, in case the input has come back.

        Args:
            elapsed: seconds since a cloud last had all its inputs.
        """
        excess = elapsed - self.params().max_wait
        return excess < 0 or excess % RETRY_PERIOD_S > RETRY_PERIOD_S - RETRY_DURATION_S

    def retry(self) -> None:
        """Deliver the waiting cloud again: its input may have arrived, or its wait may be over."""
        if self.waiting and self.missing_input is not None:
            self.deliver_trigger.trigger()

    def values(self) -> dict[str, Any]:
        """Return the counts, rates and delays of this input for /diagnostics."""
        if not self.is_open:
            return {"lost": self.arrivals.lost, "dropped": self.arrivals.dropped}
        rate, expected = self.arrivals.measure_rate(), self.get_expected_rate()
        return {
            "lost": self.arrivals.lost,
            "dropped": self.arrivals.dropped,
            "reliability": self._describe_reliability(),
            **({"rate_hz": f"{rate:.1f}"} if rate else {}),
            **({"expected_rate_hz": f"{expected:.1f}"} if expected else {}),
        }

    def get_expected_rate(self) -> float | None:
        """Return the expected rate in Hz: input.rate, or the rate of the first clouds; None before that."""
        return self.params().rate or self.arrivals.expected_rate

    def problems(self) -> list[Problem]:
        """Return the present problems of the topic with their remedies."""
        if not self.is_open:
            return []
        problems, params, publishers = list[Problem](), self.params(), self.list_publishers()
        clouds = f"{self.what}s on {self.topic}"
        if len(publishers) > 1:
            names = ", ".join(sorted(_get_full_name(p) for p in publishers))
            message = f"{len(publishers)} publishers on {self.topic} ({names}), so their {self.what}s are mixed; "
            problems.append(("publishers", WARN, message + "remap all but one"))
        if problem := self._find_incompatible_publisher(publishers):
            problems.append(problem)
        if self.waiting and self.missing_input is not None:
            message = f"the {self.what} on {self.topic} waits for {self.missing_input}"
            return [*problems, ("waiting", WARN, message)]
        if silence := self._find_silence():
            return [*problems, silence]
        expected_rate, rate = self.get_expected_rate(), self.arrivals.measure_rate()
        if expected_rate and rate and rate < params.min_rate * expected_rate:
            message = f"{rate:.1f} Hz on {self.topic}, but {expected_rate:.1f} Hz are expected (input.rate): "
            problems.append(("rate", WARN, message + self._list_hints()[1]))
        sent, lost, dropped = self.arrivals.count_recent()
        total = max(sent, WINDOW)  # so that one loss among the first two clouds does not count as 50 %
        if lost > params.max_lost * total:
            remedy = self._suggest_remedy(publishers or self.last_publishers)
            problems.append(("lost", WARN, f"{lost} of the last {sent} {clouds} were lost in transit; {remedy}"))
        if dropped > params.max_dropped * total:
            message = (
                f"{dropped} of the last {sent} {clouds} were dropped in favour of newer ones: this machine cannot "
                "process them as fast as they arrive, or they wait for poses"
            )
            problems.append(("dropped", WARN, message))
        return problems

    def _find_silence(self) -> Problem | None:
        """Return a problem if no cloud has arrived for longer than a slow sensor needs for one."""
        params, expected_rate = self.params(), self.get_expected_rate()
        period = 1 / expected_rate if expected_rate else 0.0
        silence = monotonic() - (self.last_time or monotonic())
        error_limit = max(params.error_after, SILENT_PERIODS * period)
        stale_limit = max(params.stale_after, STALE_PERIODS * period)
        if silence <= error_limit:
            return None
        kind, level, limit = ("stale", STALE, stale_limit) if silence > stale_limit else ("silent", ERROR, error_limit)
        message = f"no {self.what} on {self.topic} for more than {round(limit, 1):g} s: {self._list_hints()[0]}"
        return kind, level, message

    def _list_hints(self) -> list[str]:
        """Return the hints of HINTS for the current publishers."""
        names = sorted({_get_full_name(p) for p in self.last_publishers})
        if names and all(name.endswith("_player") for name in names):
            kind = "player"  # matches bag_player and rosbag2_player
        elif self.what != "cloud":
            kind = "detector"
        else:  # nodes of this package publish NODE/output/points
            kind = "node" if self.topic.endswith("/output/points") else "sensor"
        return [hint.format(f" {', '.join(names)}" if names else "") for hint in HINTS[kind]]

    def _find_incompatible_publisher(self, publishers: list[Any]) -> Problem | None:
        """Return a problem for best-effort publishers if the parameters demand a reliable subscription."""
        names = [_get_full_name(p) for p in publishers if p.qos_profile.reliability == BEST_EFFORT]
        adapts = not self.has_fixed_reliability and self.params().reliability != "reliable"
        if not names or adapts or self.output is not None or (self.subscription.qos_profile.reliability != RELIABLE):
            return None
        remedy = (
            f"set qos_overrides.{self.topic}.subscription.reliability to best_effort"
            if self.has_fixed_reliability
            else "set input.reliability to auto"
        )
        return (
            "incompatible",
            WARN,
            f"{', '.join(sorted(names))} on {self.topic} offers only best effort, but the "
            f"subscription is reliable, so no messages arrive: {remedy}, or make it publish reliable",
        )

    def _suggest_remedy(self, publishers: list[Any]) -> str:
        if BEST_EFFORT in {p.qos_profile.reliability for p in publishers}:
            sysctl = (
                f", or set net.core.rmem_max to {4 * SOCKET_BUFFER} (sysctl) and restart this node"
                if read_socket_buffer_size() < SOCKET_BUFFER
                else ""
            )
            return (
                f"make {_get_full_name(publishers[0])} publish reliable, or start it with "
                f"FASTRTPS_DEFAULT_PROFILES_FILE={FASTDDS_PROFILE}{sysctl}"
            )
        if self.output is None and self.subscription.qos_profile.reliability == BEST_EFFORT:
            return "make the subscription reliable: set input.reliability to auto, and remove the qos_overrides"
        return "increase the depth of the publisher's queue; between machines also net.core.rmem_max (sysctl)"


def _trigger(guard: Any) -> None:
    """Trigger a guard condition of a node that another thread may be destroying."""
    with suppress(InvalidHandle):
        guard.trigger()


def _get_full_name(endpoint: Any) -> str:
    return f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"

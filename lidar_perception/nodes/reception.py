"""How clouds come in: as reliably as they are offered, newest first, every one accounted for."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from importlib.resources import files
from time import monotonic
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from lidar_perception.nodes.shared_memory import SOCKET_BUFFER, socket_buffer
from lidar_perception.params import ReceptionParams

WARN, ERROR, STALE = DiagnosticStatus.WARN, DiagnosticStatus.ERROR, DiagnosticStatus.STALE
BEST_EFFORT, RELIABLE = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
DEPTH = 5
SHARE_OF = 100        # clouds sent, of which the lost and the dropped are counted
LEARNED_FROM = 20     # intervals between clouds; their median is what is expected
HELD = 1.0            # seconds for which a newer cloud does not take the place of one that waits
TRY_AGAIN = 5.0       # seconds between trials where waiting was in vain,
TRIAL = 0.3           # and how long one takes
RATE_OF = 10          # intervals, of which the present rate is the mean
SILENT, STALLED = 3.0, 6.0  # periods without a cloud that are no ERROR, or not STALE, yet
# Kind of publisher -> what to ask when nothing comes, and when too little does.
QUESTIONS = {
    "sensor": ("is the sensor{} running, and connected?", "is the sensor{} overloaded?"),
    "detector": ("is the detector{} running, and does it get clouds?",
                 "is the detector{} overloaded, or does it get fewer clouds?"),
    "node": ("is the node{} running, and does it get clouds?",
             "is the node{} overloaded, or does it get fewer clouds?"),
    "player": ("has the player{} reached the end of its bag, or is it paused?",
               "does the player{} play more slowly?"),
}
PROFILE = files("lidar_perception.nodes") / "fastdds.xml"

Problem = tuple[str, bytes, str]  # kind, level, message


class Arrivals:
    """What became of the clouds that were sent: sent = taken + dropped + lost.

    Publishers number their messages (publication_sequence_number). A gap is what was lost on the
    way, or, where the queue was full, what a newer cloud has pushed out of it.
    """

    def __init__(self, depth: int = DEPTH):
        self.depth = depth
        self.sent = self.dropped = self.lost = 0
        self.sequence: int | None = None  # of the last cloud
        self.window: deque[tuple[int, int, int]] = deque([(0, 0, 0)], SHARE_OF + 1)
        self.stamps: deque[tuple[int, int]] = deque(maxlen=LEARNED_FROM + 1)  # sent, ns
        self.learned: float | None = None  # Hz

    def add(self, infos: list[dict], dropped: int, one_publisher: bool = True) -> None:
        """Messages that were waiting together, oldest first; dropped is how many were not taken
        for that. Numbers of more than one publisher tell nothing."""
        full = len(infos) >= self.depth
        for i, info in enumerate(infos):
            number, gap = info["publication_sequence_number"], 0
            if one_publisher and number and self.sequence is not None and number > self.sequence:
                gap = number - self.sequence - 1
            self.sequence = (number or None) if one_publisher else None
            if full and i == 0:
                self.dropped += gap
            else:
                self.lost += gap
            self.sent += 1 + gap
            self.stamps.append((self.sent, info["source_timestamp"]))
        self.dropped += dropped
        self.window.append((self.sent, self.lost, self.dropped))
        if self.learned is None and len(self.stamps) > LEARNED_FROM:
            intervals = np.diff(np.array(self.stamps, float), axis=0)
            period = np.median(intervals[:, 1] / intervals[:, 0])
            self.learned = 1e9 / period if period > 0 else None

    def interrupted(self, dropped: int) -> None:
        """Nothing is taken for a while; dropped is how many were waiting."""
        self.dropped += dropped
        self.sequence = None
        self.stamps.clear()
        self.begin_anew()

    def begin_anew(self) -> None:
        """What was dropped so far had a reason that is over: recent() begins here."""
        self.window.clear()
        self.window.append((self.sent, self.lost, self.dropped))

    def recent(self) -> tuple[int, int, int]:
        """Of the last SHARE_OF sent, or of more where one gap was longer: how many that are, how
        many were lost, how many dropped."""
        now = self.window[-1]
        before = next((w for w in reversed(self.window) if now[0] - w[0] >= SHARE_OF),
                      self.window[0])
        sent, lost, dropped = (a - b for a, b in zip(now, before))
        return sent, lost, dropped

    def rate(self) -> float | None:
        """Clouds a second that are sent now; None while too few have come."""
        if len(self.stamps) <= RATE_OF:
            return None
        (n0, t0), (n1, t1) = self.stamps[-1 - RATE_OF], self.stamps[-1]
        return 1e9 * (n1 - n0) / (t1 - t0) if t1 > t0 else None


class Reception:
    """A subscription of clouds, or of arrays made of them. deliver gets the newest ones that are
    waiting (as many as the parameter input.queue says), as bytes, one at a time, and says what the
    cloud still needs, or None. While it is patient (up to input.max_wait seconds) it does not work
    on a cloud that needs something, and gets it again at try_again().

    It is RELIABLE where all publishers offer that, as of an ordinary driver's 2 MB a best-effort
    subscriber gets less than half; a BEST_EFFORT publisher, also one that comes later, makes it
    BEST_EFFORT, as else nothing at all would come from it. qos_overrides stand above that.
    """

    def __init__(self, node: Node, kind: type, name: str,
                 deliver: Callable[[bytes, bool], str | None],
                 params: Callable[[], ReceptionParams], what: str = "cloud"):
        self.node, self.kind, self.deliver, self.params = node, kind, deliver, params
        self.what = what  # one message, for people
        self.topic = node.resolve_topic_name(name)
        self.fixed = (f"qos_overrides.{self.topic}.subscription.reliability"
                      in node._parameter_overrides)
        self.reliability = BEST_EFFORT if params().reliability == "best_effort" else RELIABLE
        self.waiting: deque[bytes] = deque()
        self.go_on = node.create_guard_condition(self._deliver_one)
        self.look_again = node.create_guard_condition(self.adapt)
        self.last_time: float | None = None  # monotonic, of the last cloud
        self.needs: str | None = None  # by the cloud that waits, or the last one
        self.needed_since: float | None = None  # monotonic
        self.begun: float | None = None  # monotonic: since when the first one waits
        self.subscription: Any = None
        self.met: list[Any] = []  # the publishers of now, or the last ones where there are none
        self.arrivals = Arrivals()

    def open(self) -> None:
        """Subscribe."""
        self._subscribe()
        self.adapt()

    def close(self) -> None:
        """End the subscription. What waits is dropped; what is sent meanwhile is not missed."""
        if self.subscription is not None:
            self.node.destroy_subscription(self.subscription)
        self.subscription = self.last_time = None
        self.needs = self.needed_since = self.begun = None
        self.arrivals.interrupted(len(self.waiting))
        self.waiting.clear()

    def _subscribe(self) -> None:
        """What comes while a cloud is worked on waits at the middleware: as many as may wait."""
        kinds = [QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH]
        look = SubscriptionEventCallbacks(matched=lambda _: self.look_again.trigger(),
                                          incompatible_qos=lambda _: self.look_again.trigger())
        received: Any = self._received  # rclpy's annotation forgets that it may ask for the info
        profile = QoSProfile(depth=max(DEPTH, self.params().queue), reliability=self.reliability)
        self.subscription = self.node.create_subscription(
            self.kind, self.topic, received, profile, raw=True, event_callbacks=look,
            qos_overriding_options=QoSOverridingOptions(
                [*kinds, QoSPolicyKind.RELIABILITY] if self.fixed else kinds))
        self.arrivals.depth = self.subscription.qos_profile.depth

    def publishers(self) -> list[Any]:
        """What is known of those that publish the topic."""
        return self.node.get_publishers_info_by_topic(self.topic)

    def adapt(self) -> None:
        """Subscribe again if the publishers offer something else than before."""
        if self.subscription is None:
            return
        wanted, publishers = self.params().reliability, self.publishers()
        self.met = publishers or self.met
        offered = {info.qos_profile.reliability for info in publishers}
        if wanted == "auto" and offered:
            chosen = RELIABLE if offered == {RELIABLE} else BEST_EFFORT
        else:
            chosen = {"reliable": RELIABLE, "best_effort": BEST_EFFORT}.get(
                wanted, self.reliability)
        if self.fixed or chosen == self.reliability:
            return
        self.reliability = chosen
        self.node.destroy_subscription(self.subscription)
        self._subscribe()
        self.node.get_logger().info(f"{self.topic} is received {self._how()} now")

    def _how(self) -> str:
        return self.subscription.qos_profile.reliability.name.lower().replace("_", " ")

    def _received(self, data: bytes, info: dict) -> None:
        """Take all that wait at the middleware, where nobody counts what is pushed out."""
        infos, handle = [info], self.subscription.handle
        self.waiting.append(data)
        with handle:
            while taken := handle.take_message(self.kind, True):
                self.waiting.append(taken[0])
                infos.append(taken[1])
        # One that has waited for its pose for a short while is not pushed out, or none would ever
        # be answered where poses are later than the next cloud.
        held = self.begun is not None and monotonic() - self.begun < HELD
        first = [self.waiting.popleft()] if held else []
        dropped = max(0, len(self.waiting) - self.params().queue)
        for _ in range(dropped):
            self.waiting.popleft()
            self.begun = self.begun if held else None
        self.waiting.extendleft(first)
        self.arrivals.add(infos, dropped, one_publisher=len(self.publishers()) < 2)
        self._deliver_one()

    def _deliver_one(self) -> None:
        if not self.waiting:
            return
        since = self.needed_since
        patient = since is None or self._patient(monotonic() - since)
        self.needs = self.deliver(self.waiting[0], patient)
        self.last_time = monotonic()  # the work on a cloud is no silence
        self.needed_since = None if self.needs is None else since or self.last_time
        if since and self.needs is None:
            self.arrivals.begin_anew()
        if self.needs is not None and patient:
            self.begun = self.begun or self.last_time
            return
        self.waiting.popleft()
        self.begun = None
        if self.waiting:
            self.go_on.trigger()

    def _patient(self, waited: float) -> bool:
        """Whether a cloud may wait, after so many seconds without one that got what it needs; after
        max_wait only now and then, in case that comes again."""
        beyond = waited - self.params().max_wait
        return beyond < 0 or beyond % TRY_AGAIN > TRY_AGAIN - TRIAL

    def try_again(self) -> None:
        """What a cloud needs may have come, or it has waited for too long."""
        if self.waiting and self.needs is not None:
            self.go_on.trigger()

    def values(self) -> dict[str, Any]:
        """For the diagnostics."""
        if self.subscription is None:
            return {"lost": self.arrivals.lost, "dropped": self.arrivals.dropped}
        rate, expected = self.arrivals.rate(), self.expected()
        return {"lost": self.arrivals.lost, "dropped": self.arrivals.dropped,
                "reliability": self._how(),
                **({"rate_hz": f"{rate:.1f}"} if rate else {}),
                **({"expected_rate_hz": f"{expected:.1f}"} if expected else {})}

    def expected(self) -> float | None:
        """Clouds a second, as input.rate or the first clouds say; None while too few have come."""
        return self.params().rate or self.arrivals.learned

    def problems(self) -> list[Problem]:
        """What is wrong with the topic now, each with its remedy."""
        if self.subscription is None:
            return []
        found, params = [], self.params()
        publishers = self.publishers()
        if len(publishers) > 1:
            names = ", ".join(sorted(_name(p) for p in publishers))
            found.append(("publishers", WARN, f"{len(publishers)} publishers on {self.topic} "
                          f"({names}): their {self.what}s are mixed; remap all but one"))
        if unheard := self._unheard(publishers):
            found.append(unheard)
        if self.waiting and self.needs is not None:
            return [*found, ("waiting", WARN, f"the {self.what} on {self.topic} waits for "
                             f"{self.needs}")]
        if silence := self._silence():
            return [*found, silence]
        expected, rate = self.expected(), self.arrivals.rate()
        if expected and rate and rate < params.min_rate * expected:
            found.append(("rate", WARN, f"{rate:.1f} {self.what}s a second on {self.topic} where "
                          f"{expected:.1f} are expected (input.rate): {self._questions()[1]}"))
        sent, lost, dropped = self.arrivals.recent()
        enough = max(sent, SHARE_OF)  # one of the first two clouds is no half of them
        if lost > params.max_lost * enough:
            found.append(("lost", WARN, f"{lost} of the last {sent} {self.what}s on {self.topic} "
                          f"were lost on the way; {self._remedy(publishers or self.met)}"))
        if dropped > params.max_dropped * enough:
            found.append(("dropped", WARN, f"{dropped} of the last {sent} {self.what}s on "
                          f"{self.topic} were dropped, as newer ones came before their turn: the "
                          "work on one takes too long for this machine, or it waits for poses"))
        return found

    def _silence(self) -> Problem | None:
        """That nothing comes any more. A slow sensor is not silent between two clouds."""
        params, expected = self.params(), self.expected()
        period = 1 / expected if expected else 0.0
        silent = monotonic() - (self.last_time or monotonic())
        error = max(params.error_after, SILENT * period)
        stale = max(params.stale_after, STALLED * period)
        if silent <= error:
            return None
        kind, level, limit = ("stale", STALE, stale) if silent > stale else ("silent", ERROR, error)
        return (kind, level, f"no {self.what} on {self.topic} for more than {round(limit, 1):g} s: "
                f"{self._questions()[0]}")

    def _questions(self) -> list[str]:
        """Return QUESTIONS about the publishers, by their kind and names."""
        names = sorted({_name(p) for p in self.met})
        if names and all(name.endswith("_player") for name in names):
            kind = "player"  # bag_player, rosbag2_player
        elif self.what != "cloud":
            kind = "detector"
        else:  # topics of our own stages are NODE/output/points
            kind = "node" if self.topic.endswith("/output/points") else "sensor"
        return [question.format(f" {', '.join(names)}" if names else "")
                for question in QUESTIONS[kind]]

    def _unheard(self, publishers: list[Any]) -> Problem | None:
        """A best-effort publisher, where adapt() may not make the subscription fit it."""
        names = [_name(p) for p in publishers if p.qos_profile.reliability == BEST_EFFORT]
        adapts = not self.fixed and self.params().reliability != "reliable"
        if not names or adapts or self.subscription.qos_profile.reliability != RELIABLE:
            return None
        remedy = (f"set qos_overrides.{self.topic}.subscription.reliability to best_effort"
                  if self.fixed else "set input.reliability to auto")
        return ("unheard", WARN, f"{', '.join(sorted(names))} on {self.topic} is not heard, as it "
                f"offers best effort and reliable is asked for: {remedy}, or let it publish "
                "reliable")

    def _remedy(self, publishers: list[Any]) -> str:
        offered = {p.qos_profile.reliability for p in publishers}
        if BEST_EFFORT in offered:
            sysctl = (f", or set net.core.rmem_max to {4 * SOCKET_BUFFER} (sysctl) and start this "
                      "node again") if socket_buffer() < SOCKET_BUFFER else ""
            return (f"let {_name(publishers[0])} publish reliable, or start it with "
                    f"FASTRTPS_DEFAULT_PROFILES_FILE={PROFILE}{sysctl}")
        if self.subscription.qos_profile.reliability == BEST_EFFORT:
            return "receive it reliable: input.reliability auto, and no qos_overrides"
        return ("raise the depth of the publisher's queue; between machines also net.core.rmem_max "
                "(sysctl)")


def _name(endpoint: Any) -> str:
    return f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"

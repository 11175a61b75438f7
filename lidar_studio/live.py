"""The newest frames of a running graph, as the page looks at them: clouds as they come, and by
their stamps what was detected and tracked in them. Knows no ROS; who listens hands it messages."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from time import monotonic
from typing import Any

import numpy as np

from lidar_perception.intensity import StreamScale
from lidar_perception.robot.poses import transform_boxes, transform_points
from lidar_perception.robot.transform_tree import MissingTransform, TransformTree
from lidar_perception.types import InputError
from lidar_perception.wire.messages import to_truth
from lidar_perception.wire.track_markers import read_trails
from lidar_studio.drive import Scan
from lidar_studio.results import (
    compared,
    scan_in,
    shown_layers,
    source_name,
    track_id,
    tracks_of,
    with_sources,
)
from msg_utils.markers import MarkedObjects
from msg_utils.stamps import to_ns

Array = np.ndarray[Any, Any]
BOXES, TRACKS, LABELS = "detections", "tracks", "labels"  # kinds of topics beside the clouds'
MOST_BYTES, MOST_FRAMES = 300 * 10**6, 300  # of clouds that are kept: 30 s at 10 Hz
PATIENCE = 0.5   # seconds that a cloud waits for its boxes before it is shown without
EARLY = 50       # arrays that wait for their cloud


@dataclass
class Heard:
    """A topic with boxes. early: by stamp, arrays whose cloud has not come; late: arrays that came
    after their cloud was shown; alone: those without a cloud; delays: milliseconds behind it."""

    kind: str
    number: int
    came: int = 0
    late: int = 0
    alone: int = 0
    elsewhere: str = ""  # why its boxes cannot be taken to the cloud's frame
    early: OrderedDict[int, tuple[Any, Any]] = field(default_factory=OrderedDict)
    delays: deque[float] = field(default_factory=lambda: deque(maxlen=50))


@dataclass
class LiveFrame:
    """A cloud (PointCloud2) and by topic what belongs to it. came: monotonic seconds."""

    number: int
    stamp_ns: int
    cloud: Any
    came: float
    objects: dict[str, MarkedObjects] = field(default_factory=dict)
    trails: dict[str, dict[int, Array]] = field(default_factory=dict)  # by the page's ids
    shown: bool = False


class Live:
    """May be called from several threads. listeners: told of every frame that is to be shown, as
    /api/events has it; lines: what is wrong with the topics, by whoever listens; values: what is
    known of the clouds' arrival; tree: of the frames, for boxes in another one than their cloud's,
    filled by whoever calls cloud() and boxes(), in the same thread. Frames are numbered as they
    come; the oldest ones are dropped once there are more than MOST_FRAMES, or MOST_BYTES of them.
    """

    def __init__(self, name: str, most_bytes: int = MOST_BYTES,
                 most_frames: int = MOST_FRAMES) -> None:
        self.name, self.most_bytes, self.most_frames = name, most_bytes, most_frames
        self.listeners: list[Callable[[dict[str, Any]], None]] = []
        self.lines: list[str] = []
        self.values: Mapping[str, Any] = {}
        self.topics: dict[str, Heard] = {}
        self.tree = TransformTree()
        self.passed = 0          # frames that came while somebody had paused
        self._frames: dict[int, LiveFrame] = {}
        self._by_stamp: dict[int, LiveFrame] = {}
        self._next = self._bytes = 0
        self._holding: set[int] = set()
        self._unplaced: list[tuple[LiveFrame, str, MarkedObjects, Any]] = []  # until TF has come
        self._numbers: dict[tuple[str, str], int] = {}  # of each topic among those of its kind
        self._said: dict[str, Any] = {}
        self._scale = StreamScale()
        self._lock = threading.RLock()

    @property
    def first(self) -> int:
        """Number of the oldest frame that is kept."""
        with self._lock:
            return next(iter(self._frames), self._next)

    @property
    def end(self) -> int:
        """One more than the number of the newest frame."""
        return self._next

    def hold(self, page: int, yes: bool) -> None:
        """While a page holds them, the frames that are kept stay, and new ones are passed over."""
        with self._lock:
            (self._holding.add if yes else self._holding.discard)(page)

    def hear(self, topic: str, kind: str) -> None:
        """Expect boxes of a kind on a topic: clouds wait for them."""
        with self._lock:
            if topic not in self.topics:
                number = sum(known == kind for known, _ in self._numbers)
                self.topics[topic] = Heard(kind, self._numbers.setdefault((kind, topic), number))

    def forget(self, topic: str) -> None:
        """Nobody publishes the topic any more."""
        with self._lock:
            self.topics.pop(topic, None)

    def cloud(self, message: Any) -> None:
        """A PointCloud2 came. Boxes are of the last one with their stamp: a bag may begin again."""
        with self._lock:
            stamp = to_ns(message.header.stamp)
            if self._holding:
                self.passed += 1
                return
            frame = LiveFrame(self._next, stamp, message, monotonic())
            self._frames[self._next] = self._by_stamp[stamp] = frame
            self._next += 1
            self._bytes += len(message.data)
            while len(self._frames) > 1 and (self._bytes > self.most_bytes
                                             or len(self._frames) > self.most_frames):
                old = self._frames.pop(self.first)
                if self._by_stamp.get(old.stamp_ns) is old:
                    del self._by_stamp[old.stamp_ns]
                self._bytes -= len(old.cloud.data)
            for topic, heard in self.topics.items():
                if stamp in heard.early:
                    self._add(frame, topic, *heard.early.pop(stamp))
        self.tick()

    def boxes(self, topic: str, objects: MarkedObjects, message: Any) -> None:
        """An array of boxes came; message: the MarkerArray, whose trails are drawn, or None."""
        with self._lock:
            if (heard := self.topics.get(topic)) is None:
                return
            heard.came += 1
            objects = _usable(objects)
            frame = self._by_stamp.get(objects.stamp_ns)
            if frame is None or topic in frame.objects:  # then a bag began again, and it is early
                heard.early[objects.stamp_ns] = objects, message
                while len(heard.early) > EARLY:
                    heard.early.popitem(last=False)
                    heard.alone += not self._holding
                return
            heard.delays.append(1e3 * (monotonic() - frame.came))
            self._add(frame, topic, objects, message)
        self.tick()

    def _add(self, frame: LiveFrame, topic: str, objects: MarkedObjects, message: Any) -> None:
        """In the frame of its cloud, at its stamp; once TF has come, where that is late."""
        heard, own = self.topics[topic], frame.cloud.header.frame_id
        trails = read_trails(message) if message is not None and heard.kind == TRACKS else {}
        if objects.frame_id.lstrip("/") not in ("", own.lstrip("/")):
            try:
                pose = self.tree.lookup(own, objects.frame_id, frame.stamp_ns)
            except MissingTransform as error:
                if error.late and monotonic() - frame.came <= PATIENCE:
                    self._unplaced.append((frame, topic, objects, message))
                else:
                    heard.elsewhere = str(error)
                return
            objects = replace(objects, boxes=transform_boxes(objects.boxes, pose))
            trails = {number: transform_points(trail, pose) for number, trail in trails.items()}
        heard.elsewhere = ""
        frame.objects[topic] = objects
        frame.trails[topic] = {track_id(heard.number, n): trail for n, trail in trails.items()}
        if frame.shown:
            # Labels come when they like; nobody knew that the first of a topic was to come.
            heard.late += heard.kind != LABELS and heard.came > 1
            self._tell(self._event(frame))

    def tick(self) -> None:
        """Show the newest frame that has all its boxes, or has waited for them long enough; to be
        called again and again. Also what is known of the topics is told when it has changed."""
        with self._lock:
            now = monotonic()
            unplaced, self._unplaced = self._unplaced, []
            for each in unplaced:
                if each[1] in self.topics:
                    self._add(*each)
            wanted = {t for t, h in self.topics.items() if h.came and h.kind != LABELS
                      and not h.elsewhere}
            for frame in reversed(self._frames.values()):
                if frame.shown:
                    break
                if wanted <= frame.objects.keys() or now - frame.came > PATIENCE:
                    for older in self._frames.values():
                        if not older.shown and older.number <= frame.number:
                            older.shown = True
                            self._tell(self._event(older))
                    break
            if (status := self.status()) != self._said:
                self._said = status
                self._tell({"status": status})

    def _tell(self, event: dict[str, Any]) -> None:
        for listener in list(self.listeners):
            listener(event)

    def status(self) -> dict[str, Any]:
        """What is wrong, in lines for a person; of each topic how many arrays came, came late or
        without a cloud, and how far behind; of the clouds what `values` says."""
        with self._lock:
            lines = [*self.lines, *(
                f"boxes of {topic} are not shown: {heard.elsewhere}"
                for topic, heard in self.topics.items() if heard.elsewhere)]
            return {"lines": lines, "clouds": {**self.values, "passed": self.passed},
                    "topics": [{"topic": topic, "kind": heard.kind, "came": heard.came,
                                "late": heard.late, "alone": heard.alone,
                                "ms": round(float(np.median(heard.delays)), -1) if heard.delays
                                else None} for topic, heard in self.topics.items()]}

    def _event(self, frame: LiveFrame) -> dict[str, Any]:
        return {"live": {"first": self.first, **_named(frame), "tracks": self._tracks([frame])}}

    def _tracks(self, frames: list[LiveFrame]) -> list[dict[str, Any]]:
        """As the page has them, with their trails by frame."""
        made: list[dict[str, Any]] = []
        for topic, heard in self.topics.items():
            if heard.kind != TRACKS:
                continue
            with_them = {f.number: f.objects[topic] for f in frames if topic in f.objects}
            for track in tracks_of(with_them, topic, heard.number):
                track["trails"] = {
                    f.number: np.round(f.trails[topic][track["id"]], 3).tolist() for f in frames
                    if track["id"] in f.trails.get(topic, ())}
                made.append(track)
        return made

    def tracks(self) -> list[dict[str, Any]]:
        """Of all frames that are kept."""
        with self._lock:
            return self._tracks([f for f in self._frames.values() if f.shown])

    def frames(self) -> list[dict[str, Any]]:
        """Those that are kept and to be shown, as /api/drive has them."""
        with self._lock:
            return [_named(frame) for frame in self._frames.values() if frame.shown]

    def _frame(self, i: int) -> LiveFrame:
        with self._lock:
            if (frame := self._frames.get(i)) is None:
                raise InputError(f"frame {i} is kept no more; those from {self.first} on are")
            return frame

    def clouds(self, i: int) -> Scan:
        """The points of a frame, with the ground and clusters that its cloud has. InputError where
        it is broken, or kept no more."""
        return scan_in(self._frame(i).cloud, scale=self._scale)

    def layers(self, i: int, min_score: float) -> dict[str, Any]:
        """Labels and detections of a frame, as /api/labels has them, and what is missed from this
        score on; what is false cannot be said, as it is not known where labels end."""
        with self._lock:
            objects = self._frame(i).objects
            of_kind = {kind: {t: o for t, o in objects.items() if t in self.topics
                              and self.topics[t].kind == kind} for kind in (BOXES, LABELS)}
        found = {source_name(t): with_sources(o) for t, o in of_kind[BOXES].items()}
        truth = next((to_truth(o) for o in of_kind[LABELS].values()), None)
        matches = {} if truth is None else {
            name: {**compared(truth, d, min_score), "false": None, "ignored": None}
            for name, d in found.items()}
        return shown_layers(truth, found, matches)


def _usable(objects: MarkedObjects) -> MarkedObjects:
    """Those with finite numbers and sides above 0, as any node may send others."""
    good = (np.isfinite(objects.boxes).all(axis=1) & (objects.boxes[:, 3:6] > 0).all(axis=1)
            & np.isfinite(objects.scores))
    if good.all():
        return objects
    rows = np.flatnonzero(good).tolist()
    return replace(objects, boxes=objects.boxes[good], scores=objects.scores[good],
                   ids=objects.ids[good], labels=[objects.labels[k] for k in rows],
                   extras=[objects.extras[k] for k in rows])


def _named(frame: LiveFrame) -> dict[str, Any]:
    return {"frame": frame.number, "name": f"{frame.stamp_ns / 1e9:.2f} s",
            "stamp_ns": frame.stamp_ns}

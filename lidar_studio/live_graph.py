"""Newest frames of a running graph, which combine clouds and boxes with the same stamp.

This module does not depend on ROS; the node in live_view.py adds the messages.
"""

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
    convert_to_detections,
    get_source_name,
    layers_to_json,
    make_track_id,
    match_detections,
    scan_from_message,
    tracks_to_json,
)
from msg_utils.markers import MarkedObjects
from msg_utils.stamps import to_ns

Array = np.ndarray[Any, Any]
BOXES, TRACKS, LABELS = "detections", "tracks", "labels"  # kinds of box topics
MAX_BYTES, MAX_FRAMES = 300 * 10**6, 300  # limits of the stored clouds; 300 frames are 30 s at 10 Hz
MAX_WAIT_S = 0.5  # maximum time for which a cloud waits for its boxes before it is shown without them
MAX_EARLY_ARRAYS = 50  # maximum number of stored arrays per topic whose cloud has not arrived


@dataclass
class BoxTopic:
    """A topic with boxes, and its statistics.

    Attributes:
        index: Index among the topics of the same kind.
        late_count: Number of arrays that arrived after their cloud was shown.
        unmatched_count: Number of arrays without a cloud.
        tf_problem: Reason why boxes cannot be transformed to the cloud's frame, or "".
        early_arrays: Arrays whose cloud has not arrived yet, by stamp.
        delays: Delays of the last arrays relative to their clouds, in milliseconds.
    """

    kind: str
    index: int
    received_count: int = 0
    late_count: int = 0
    unmatched_count: int = 0
    tf_problem: str = ""
    early_arrays: OrderedDict[int, tuple[Any, Any]] = field(default_factory=OrderedDict)
    delays: deque[float] = field(default_factory=lambda: deque(maxlen=50))


@dataclass
class LiveFrame:
    """A cloud (PointCloud2) with its objects and trails by topic.

    Attributes:
        received_s: Time of arrival on the monotonic clock, in seconds.
        trails: Trails by topic and make_track_id(...).
    """

    number: int
    stamp_ns: int
    cloud: Any
    received_s: float
    objects: dict[str, MarkedObjects] = field(default_factory=dict)
    trails: dict[str, dict[int, Array]] = field(default_factory=dict)
    is_shown: bool = False


class LiveGraph:
    """Thread-safe store of the newest frames of a running graph.

    Frames are numbered in order of arrival. The oldest frames are dropped above max_frames or max_bytes.

    Attributes:
        listeners: Functions called with every event of /api/events.
        problems: Problems with the topics, set by the node.
        statistics: Reception statistics of the clouds, set by the node.
        tree: Transforms between frames, filled by the thread that adds clouds and boxes.
    """

    def __init__(self, name: str, max_bytes: int = MAX_BYTES, max_frames: int = MAX_FRAMES) -> None:
        self.name, self.max_bytes, self.max_frames = name, max_bytes, max_frames
        self.listeners: list[Callable[[dict[str, Any]], None]] = []
        self.problems: list[str] = []
        self.statistics: Mapping[str, Any] = {}
        self.topics: dict[str, BoxTopic] = {}
        self.tree = TransformTree()
        self.skipped_count = 0  # clouds that arrived while a page was paused
        self._frames: dict[int, LiveFrame] = {}
        self._by_stamp: dict[int, LiveFrame] = {}
        self._next = self._bytes = 0
        self._paused_pages: set[int] = set()
        self._awaiting_tf: list[tuple[LiveFrame, str, MarkedObjects, Any]] = []
        self._topic_indices: dict[tuple[str, str], int] = {}  # (kind, topic) -> BoxTopic.index
        self._last_status: dict[str, Any] = {}
        self._scale = StreamScale()
        self._lock = threading.RLock()

    @property
    def first(self) -> int:
        """Number of the oldest stored frame."""
        with self._lock:
            return next(iter(self._frames), self._next)

    @property
    def end(self) -> int:
        """One past the number of the newest frame."""
        return self._next

    def set_paused(self, page: int, is_paused: bool) -> None:
        """Pause or resume a page. New clouds are skipped while any page is paused."""
        with self._lock:
            (self._paused_pages.add if is_paused else self._paused_pages.discard)(page)

    def expect_topic(self, topic: str, kind: str) -> None:
        """Add a topic with boxes of a kind. Clouds wait for its arrays."""
        with self._lock:
            if topic not in self.topics:
                next_index = sum(other_kind == kind for other_kind, _ in self._topic_indices)
                self.topics[topic] = BoxTopic(kind, self._topic_indices.setdefault((kind, topic), next_index))

    def forget_topic(self, topic: str) -> None:
        """Remove a topic that should no longer be shown."""
        with self._lock:
            self.topics.pop(topic, None)

    def add_cloud(self, message: Any) -> None:
        """Add a PointCloud2. Boxes are matched to the last cloud with their stamp, because bags may loop."""
        with self._lock:
            stamp = to_ns(message.header.stamp)
            if self._paused_pages:
                self.skipped_count += 1
                return
            frame = LiveFrame(self._next, stamp, message, monotonic())
            self._frames[self._next] = self._by_stamp[stamp] = frame
            self._next += 1
            self._bytes += len(message.data)
            while len(self._frames) > 1 and (self._bytes > self.max_bytes or len(self._frames) > self.max_frames):
                oldest_frame = self._frames.pop(self.first)
                if self._by_stamp.get(oldest_frame.stamp_ns) is oldest_frame:
                    del self._by_stamp[oldest_frame.stamp_ns]
                self._bytes -= len(oldest_frame.cloud.data)
            for topic, box_topic in self.topics.items():
                if stamp in box_topic.early_arrays:
                    self._add_objects(frame, topic, *box_topic.early_arrays.pop(stamp))
        self.update()

    def add_boxes(self, topic: str, objects: MarkedObjects, message: Any) -> None:
        """Add an array of boxes.

        Args:
            message: The MarkerArray that contains their trails, or None.
        """
        with self._lock:
            if (box_topic := self.topics.get(topic)) is None:
                return
            box_topic.received_count += 1
            objects = _keep_valid(objects)
            frame = self._by_stamp.get(objects.stamp_ns)
            if frame is None or topic in frame.objects:  # the array is early, or a bag is looping
                box_topic.early_arrays[objects.stamp_ns] = objects, message
                while len(box_topic.early_arrays) > MAX_EARLY_ARRAYS:
                    box_topic.early_arrays.popitem(last=False)
                    box_topic.unmatched_count += not self._paused_pages
                return
            box_topic.delays.append(1e3 * (monotonic() - frame.received_s))
            self._add_objects(frame, topic, objects, message)
        self.update()

    def _add_objects(self, frame: LiveFrame, topic: str, objects: MarkedObjects, message: Any) -> None:
        """Transform boxes to the frame of the cloud and add them to `frame`.

        If their transform has not arrived yet, a later update() adds them.
        """
        box_topic, frame_id = self.topics[topic], frame.cloud.header.frame_id
        trails = read_trails(message) if message is not None and box_topic.kind == TRACKS else {}
        if objects.frame_id.lstrip("/") not in ("", frame_id.lstrip("/")):
            try:
                pose = self.tree.lookup(frame_id, objects.frame_id, frame.stamp_ns)
            except MissingTransform as error:
                if error.late and monotonic() - frame.received_s <= MAX_WAIT_S:
                    self._awaiting_tf.append((frame, topic, objects, message))
                else:
                    box_topic.tf_problem = str(error)
                return
            objects = replace(objects, boxes=transform_boxes(objects.boxes, pose))
            trails = {number: transform_points(trail, pose) for number, trail in trails.items()}
        box_topic.tf_problem = ""
        frame.objects[topic] = objects
        frame.trails[topic] = {make_track_id(box_topic.index, n): trail for n, trail in trails.items()}
        if frame.is_shown:
            # Clouds wait neither for labels nor for the first array of a topic, so these are not late.
            box_topic.late_count += box_topic.kind != LABELS and box_topic.received_count > 1
            self._notify(self._make_event(frame))

    def update(self) -> None:
        """Show the newest frame that is complete or has waited for MAX_WAIT_S, and report status changes.

        This method must be called periodically.
        """
        with self._lock:
            now = monotonic()
            awaiting_tf, self._awaiting_tf = self._awaiting_tf, []
            for frame, topic, objects, message in awaiting_tf:
                if topic in self.topics:
                    self._add_objects(frame, topic, objects, message)
            expected_topics = {
                topic for topic, t in self.topics.items() if t.received_count and t.kind != LABELS and not t.tf_problem
            }
            for frame in reversed(self._frames.values()):
                if frame.is_shown:
                    break
                if expected_topics <= frame.objects.keys() or now - frame.received_s > MAX_WAIT_S:
                    for older_frame in self._frames.values():
                        if not older_frame.is_shown and older_frame.number <= frame.number:
                            older_frame.is_shown = True
                            self._notify(self._make_event(older_frame))
                    break
            if (status := self.get_status()) != self._last_status:
                self._last_status = status
                self._notify({"status": status})

    def _notify(self, event: dict[str, Any]) -> None:
        for listener in list(self.listeners):
            listener(event)

    def get_status(self) -> dict[str, Any]:
        """Return the problems as lines of text, and the statistics of the clouds and of each box topic."""
        with self._lock:
            lines = [
                *self.problems,
                *(
                    f"boxes of {topic} are not shown: {box_topic.tf_problem}"
                    for topic, box_topic in self.topics.items()
                    if box_topic.tf_problem
                ),
            ]
            return {
                "lines": lines,
                "clouds": {**self.statistics, "skipped": self.skipped_count},
                "topics": [
                    {
                        "topic": topic,
                        "kind": t.kind,
                        "received": t.received_count,
                        "late": t.late_count,
                        "unmatched": t.unmatched_count,
                        "ms": round(float(np.median(t.delays)), -1) if t.delays else None,
                    }
                    for topic, t in self.topics.items()
                ],
            }

    def _make_event(self, frame: LiveFrame) -> dict[str, Any]:
        return {"live": {"first": self.first, **_frame_to_json(frame), "tracks": self._tracks_to_json([frame])}}

    def _tracks_to_json(self, frames: list[LiveFrame]) -> list[dict[str, Any]]:
        tracks: list[dict[str, Any]] = []
        for topic, box_topic in self.topics.items():
            if box_topic.kind != TRACKS:
                continue
            objects = {f.number: f.objects[topic] for f in frames if topic in f.objects}
            for track in tracks_to_json(objects, topic, box_topic.index):
                track["trails"] = {
                    f.number: np.round(f.trails[topic][track["id"]], 3).tolist()
                    for f in frames
                    if track["id"] in f.trails.get(topic, ())
                }
                tracks.append(track)
        return tracks

    def list_tracks(self) -> list[dict[str, Any]]:
        """Return the tracks in all shown frames, as JSON objects for the page."""
        with self._lock:
            return self._tracks_to_json([f for f in self._frames.values() if f.is_shown])

    def list_frames(self) -> list[dict[str, Any]]:
        """Return the shown frames, as JSON objects of /api/drive."""
        with self._lock:
            return [_frame_to_json(frame) for frame in self._frames.values() if frame.is_shown]

    def _get_frame(self, i: int) -> LiveFrame:
        with self._lock:
            if (frame := self._frames.get(i)) is None:
                raise InputError(f"frame {i} is no longer stored; the oldest stored frame is {self.first}")
            return frame

    def load_scan(self, i: int) -> Scan:
        """Return the scan of a frame. Raises InputError if the cloud is invalid or no longer stored."""
        return scan_from_message(self._get_frame(i).cloud, scale=self._scale)

    def make_layers(self, i: int, min_score: float) -> dict[str, Any]:
        """Return the JSON object of /api/labels: labels, detections and missed labels of a frame.

        It lists no false positives, because the labelled area is unknown.
        """
        with self._lock:
            objects = self._get_frame(i).objects
            objects_by_kind = {
                kind: {t: o for t, o in objects.items() if t in self.topics and self.topics[t].kind == kind}
                for kind in (BOXES, LABELS)
            }
        detections = {get_source_name(t): convert_to_detections(o) for t, o in objects_by_kind[BOXES].items()}
        truth = next((to_truth(o) for o in objects_by_kind[LABELS].values()), None)
        matches = (
            {}
            if truth is None
            else {
                name: {**match_detections(truth, d, min_score), "false": None, "ignored": None}
                for name, d in detections.items()
            }
        )
        return layers_to_json(truth, detections, matches)


def _keep_valid(objects: MarkedObjects) -> MarkedObjects:
    """Drop objects with non-finite numbers or non-positive sizes."""
    is_valid = (
        np.isfinite(objects.boxes).all(axis=1) & (objects.boxes[:, 3:6] > 0).all(axis=1) & np.isfinite(objects.scores)
    )
    if is_valid.all():
        return objects
    rows = np.flatnonzero(is_valid).tolist()
    return replace(
        objects,
        boxes=objects.boxes[is_valid],
        scores=objects.scores[is_valid],
        ids=objects.ids[is_valid],
        labels=[objects.labels[k] for k in rows],
        extras=[objects.extras[k] for k in rows],
    )


def _frame_to_json(frame: LiveFrame) -> dict[str, Any]:
    return {"frame": frame.number, "name": f"{frame.stamp_ns / 1e9:.2f} s", "stamp_ns": frame.stamp_ns}

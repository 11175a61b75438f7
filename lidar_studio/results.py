"""Results to view: labels, tracks and detections, with misses and false positives.

Detections are read from a bag or from result files, or a detector computes them on request.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.camera import Camera
from lidar_perception.classes import CLASSES, DETECTED, PEDESTRIAN, TABLE
from lidar_perception.data.bag import Bag
from lidar_perception.data.bag_frames import choose_cloud_topic
from lidar_perception.data.bag_poses import BagPoses
from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti.results import choose_calibration, find_result_folder, read_results
from lidar_perception.data.to_bag import MARKERS
from lidar_perception.detectors.contract import Detector
from lidar_perception.geometry import bev_iou
from lidar_perception.intensity import infer_full_scale
from lidar_perception.runs.terminal import errors
from lidar_perception.scoring.centres.matching import MAX_CENTRE_DISTANCE, assign_pairs
from lidar_perception.scoring.recorded import read_objects_by_stamp
from lidar_perception.types import Detections, GroundTruth, InputError
from lidar_perception.wire.messages import FullScale, read_cluster_ids, read_column, to_detections, to_point_cloud
from lidar_perception.wire.topics import DETECTIONS, TRACKS, TRUTH
from lidar_studio.drive import Drive, Scan, segment_frame, to_scan
from msg_utils.markers import MarkedObjects

Array = np.ndarray[Any, Any]
SIMILAR_CLASS = {row.name: row.looks_like or row.name for row in TABLE}
CLUSTERED_TOPICS = ("/clustering/output/points", "/perception/output/points")
MAX_SOURCES = 8  # maximum number of probabilities shown per detection
MAX_CACHED_FRAMES = 2000
TRACKER_ID_STEP = 10**10  # offset between the track ids of two trackers; larger than any 32-bit marker id


@dataclass(frozen=True)
class Source:
    """A source of detections.

    Attributes:
        detect: Function of (frame index, frame) that returns the detections in the frame.
        classes: Names of the classes that the source can detect.
    """

    detect: Callable[[int, Frame], Detections]
    classes: frozenset[str] = frozenset(DETECTED)


@dataclass(frozen=True)
class Results:
    """Detection sources by name, and tracks as JSON objects for the page."""

    sources: Mapping[str, Source] = field(default_factory=dict)
    tracks: tuple[dict[str, Any], ...] = ()

    def make_layers(self, i: int, frame: Frame, min_score: float) -> dict[str, Any]:
        """Return the JSON object of /api/labels for frame i: labels and detections, and the misses and
        false positives at a minimum score."""
        truth = frame.truth()
        camera = frame.camera() if self.sources and truth is not None else None
        detections = {name: source.detect(i, frame) for name, source in self.sources.items()}
        matches = (
            {}
            if truth is None
            else {
                name: match_detections(truth, d, min_score, camera, self.sources[name].classes)
                for name, d in detections.items()
            }
        )
        return layers_to_json(truth, detections, matches)

    def bind_layers(self, drive: Drive) -> Callable[[int, float], dict[str, Any]]:
        """Return make_layers() for the frames of a drive, as a function of (i, min_score)."""
        return lambda i, min_score: self.make_layers(i, drive.frames[i], min_score)


def layers_to_json(
    truth: GroundTruth | None, detections: Mapping[str, Detections], matches: Mapping[str, Any]
) -> dict[str, Any]:
    """Convert labels and detections to rows of a box, its class, and a track id or score.

    Args:
        detections: Detections by source. Their rows end with the probabilities of the sources that
            the detector combines.
    """
    labels = (
        []
        if truth is None
        else [
            [*map(float, box), name, extra.get("track_id")]
            for box, name, extra in zip(truth.boxes, truth.labels, truth.extras)
        ]
    )
    rows = {}
    for name, d in detections.items():
        source_scores = [
            {k: round(float(v[i]), 3) for k, v in d.sources.items() if np.isfinite(v[i])} for i in range(len(d))
        ]
        rows[name] = [
            [*map(float, box), CLASSES[c], float(score), row]
            for box, c, score, row in zip(d.boxes, d.class_ids, d.scores, source_scores)
        ]
    return {"labels": labels, "detections": rows, "matches": dict(matches)}


def match_detections(
    truth: GroundTruth,
    detections: Detections,
    min_score: float,
    camera: Camera | None = None,
    classes: frozenset[str] = frozenset(DETECTED),
) -> dict[str, list[int]]:
    """Match the detections with a score of at least min_score to the labels.

    A match must reach the relaxed BEV overlap of its class, or for pedestrians a centre distance of at
    most 1 m. Every label is matched, missed or ignored; every detection is a true positive, a false
    positive or ignored.

    Args:
        camera: Detections outside its view are ignored, because only objects in view are labelled.
        classes: Classes that the source can detect. Labels of other classes are ignored, and so are
            labels of similar objects, such as vans, and detections that match them.

    Returns:
        Indices: `missed` and `ignored_labels` of labels, `false` and `ignored` of detections.
    """
    missed_labels, false_positives, true_positives = [], [], []
    true_names = np.array([SIMILAR_CLASS[CLASSES[c]] for c in truth.class_ids], object)
    for name in classes & DETECTED.keys():
        labels = np.flatnonzero(true_names == name)
        rows = np.flatnonzero((detections.class_ids == CLASSES.index(name)) & (detections.scores >= min_score))
        boxes, label_boxes = detections.boxes[rows].astype(np.float64), truth.boxes[labels]
        overlaps = bev_iou(boxes, label_boxes)
        can_match = overlaps >= DETECTED[name].relaxed
        if name == CLASSES[PEDESTRIAN]:
            distances = np.linalg.norm(boxes[:, None, :2] - label_boxes[None, :, :2], axis=2)
            can_match |= distances <= MAX_CENTRE_DISTANCE
        i, j = assign_pairs(1.0 - overlaps, can_match) if can_match.size else (np.zeros(0, int), np.zeros(0, int))
        is_same_class = truth.class_ids[labels] == CLASSES.index(name)
        missed_labels += labels[is_same_class & ~np.isin(np.arange(len(labels)), j)].tolist()
        true_positives += rows[i[is_same_class[j]]].tolist()
        unmatched_rows = np.delete(rows, i)
        if camera is not None and len(unmatched_rows):
            unmatched_rows = unmatched_rows[camera.in_view(detections.boxes[unmatched_rows, :3])]
        false_positives += unmatched_rows.tolist()
    scored_classes = [CLASSES.index(name) for name in classes & DETECTED.keys()]
    scored_rows = np.flatnonzero(detections.scores >= min_score)
    return {
        "missed": sorted(missed_labels),
        "false": sorted(false_positives),
        "ignored_labels": np.flatnonzero(~np.isin(truth.class_ids, scored_classes)).tolist(),
        "ignored": np.setdiff1d(scored_rows, [*true_positives, *false_positives]).tolist(),
    }


def make_detector_source(detector: Detector) -> Source:
    """Return a source that runs a detector on request and caches its detections."""

    @lru_cache(maxsize=MAX_CACHED_FRAMES)
    def detect(i: int, frame: Frame) -> Detections:
        return detector(frame.load()).detections

    return Source(detect, frozenset(detector.classes))


def make_file_source(folder: Path) -> Source:
    """Return a source that reads KITTI result files folder/NAME.txt, or the output folder of `detect`.

    A frame without a file has no detections. The source raises InputError for an invalid file.
    """
    if not folder.is_dir():
        raise InputError(f"result folder {folder} does not exist")
    result_folder = find_result_folder(folder)

    @lru_cache(maxsize=MAX_CACHED_FRAMES)
    def read(i: int, frame: Frame) -> Detections:
        path = result_folder / f"{frame.name}.txt"
        if not path.exists():
            return Detections.none()
        rows = read_results(path, choose_calibration(frame)[0].lidar_to_camera)
        return Detections.of(rows.boxes, rows.class_ids, [e["score"] for e in rows.extras])

    return Source(read)


def choose_points_topic(path: Path) -> str:
    """Choose the cloud topic of a bag: one with clusters, otherwise the one that choose_cloud_topic() returns.

    Raises InputError if the choice is ambiguous.
    """
    with Bag(path) as bag:
        clustered_topics = [topic for topic in CLUSTERED_TOPICS if bag.counts.get(topic)]
        return clustered_topics[0] if clustered_topics else choose_cloud_topic(bag)


def read_recorded_results(poses: BagPoses, stamps: list[int]) -> Results:
    """Read the detections and tracks of all nodes in a bag for clouds with these stamps (ns).

    A topic whose boxes cannot be transformed to the clouds' frame is skipped with a warning.
    """
    bag = poses.handle.get_bag()
    topics = {
        topic
        for topic, kind in bag.topics.items()
        if kind == MARKERS and topic != TRUTH and topic.endswith((DETECTIONS, TRACKS))
    }
    objects_by_topic = read_objects_by_stamp(bag, sorted(topics))
    index_by_stamp = {stamp: i for i, stamp in enumerate(stamps)}
    sources: dict[str, Source] = {}
    tracks: list[dict[str, Any]] = []
    trackers = [topic for topic in objects_by_topic if topic.endswith(TRACKS)]
    for topic, objects_by_stamp in objects_by_topic.items():
        try:
            frames = {
                index_by_stamp[stamp]: poses.to_cloud_frame(objects, topic)
                for stamp, objects in objects_by_stamp.items()
                if stamp in index_by_stamp
            }
        except InputError as error:
            errors.print(f"skipped: {error}", style="yellow")
            continue
        if topic in trackers:
            tracks += tracks_to_json(frames, topic, trackers.index(topic))
        else:
            sources[get_source_name(topic)] = _make_source(
                {i: convert_to_detections(objects) for i, objects in frames.items()}
            )
    return Results(sources, tuple(tracks))


def convert_to_detections(objects: MarkedObjects) -> Detections:
    """Convert markers to detections, with the probabilities by source that the markers' text contains."""
    probabilities = [e["sources"] if isinstance(e.get("sources"), dict) else {} for e in objects.extras]
    names = list(dict.fromkeys(name for row in probabilities for name in row))[:MAX_SOURCES]
    return replace(
        to_detections(objects),
        sources={
            name: np.array([_to_probability(row.get(name)) for row in probabilities], np.float32) for name in names
        },
    )


def _to_probability(value: Any) -> float:
    return float(value) if isinstance(value, int | float) and 0 <= value <= 1 else np.nan


def get_source_name(topic: str) -> str:
    """Return the name of a topic's node, such as fused_detector for /fused_detector/output/detections."""
    return topic.strip("/").removesuffix(DETECTIONS)


def _make_source(detections_by_frame: Mapping[int, Detections]) -> Source:
    classes = {CLASSES[c] for detections in detections_by_frame.values() for c in detections.class_ids}
    return Source(lambda i, frame: detections_by_frame.get(i, Detections.none()), frozenset(classes))


def read_recorded_scan(frame: Frame) -> Scan:
    """Return the scan of a frame in a bag, with recorded ground and clusters if the cloud contains them.

    Raises InputError if the cloud cannot be read.
    """
    message = frame.native()
    is_segmented = {"ground", "cluster_id"} <= {field.name for field in message.fields}
    return scan_from_message(message, frame.intensity_max()) if is_segmented else segment_frame(frame)


def scan_from_message(message: Any, intensity_max: float = 0.0, scale: FullScale = infer_full_scale) -> Scan:
    """Convert a PointCloud2 to a scan, with ground and clusters if the cloud has these columns.

    See to_point_cloud() for intensity_max and scale. Raises InputError if the message is invalid.
    """
    cloud, indices = to_point_cloud(message, intensity_max, scale)
    ground, clusters = read_column(message, "ground", indices), read_cluster_ids(message, indices)
    return to_scan(
        cloud,
        np.zeros(len(cloud), bool) if ground is None else ground > 0,
        np.zeros(len(cloud), np.int32) if clusters is None else clusters[0],
    )


def make_track_id(tracker: int, number: int) -> int:
    """Return a track id that is unique over all trackers, from the tracker's index and its own track id."""
    return tracker * TRACKER_ID_STEP + number % TRACKER_ID_STEP


def tracks_to_json(frames: Mapping[int, MarkedObjects], topic: str, tracker: int) -> list[dict[str, Any]]:
    """Convert the messages of a tracker to tracks, as JSON objects for the page.

    Args:
        frames: Message of each frame, by frame index.
        tracker: Index of the tracker, see make_track_id().
    """
    tracks: dict[int, dict[str, Any]] = {}
    for i in sorted(frames):
        objects = frames[i]
        for box, label, number, score in zip(objects.boxes, objects.labels, objects.ids.tolist(), objects.scores):
            track = tracks.setdefault(
                number,
                {
                    "id": make_track_id(tracker, number),
                    "class": label,
                    "state": "accepted",
                    "score": 0.0,
                    "source": topic.strip("/").split("/")[0],
                    "boxes": [],
                    "uncertainty": 0.0,
                },
            )
            track["class"] = label  # keep the latest class
            track["score"] = max(track["score"], float(score))
            track["boxes"].append([i, *map(float, box), "proposed"])
    return list(tracks.values())

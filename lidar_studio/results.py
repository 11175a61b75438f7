"""Results to be looked at: labels and what each source detected, frame by frame, with what is
missed and what is false; tracks. Read from a bag, from result files, or detected when asked for."""

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
from lidar_perception.scoring.centres.matching import MAX_CENTRE_DISTANCE, one_to_one
from lidar_perception.scoring.recorded import by_stamp
from lidar_perception.types import Detections, GroundTruth, InputError
from lidar_perception.wire.messages import (
    FullScale,
    read_cluster_ids,
    read_column,
    to_detections,
    to_point_cloud,
)
from lidar_perception.wire.topics import FOUND, TRACKS, TRUTH
from lidar_studio.drive import Drive, Scan, scan_of, scanned
from msg_utils.markers import MarkedObjects

Array = np.ndarray[Any, Any]
SIMILAR = {row.name: row.looks_like or row.name for row in TABLE}
CLUSTERED = ("/clustering/output/points", "/perception/output/points")
MOST_SOURCES = 8                             # of one detection that are shown
KEPT = 2000                                  # frames whose detections are kept
APART = 10**10  # between the ids of one tracker's tracks and the next's; a marker's have 32 bits


def with_recorded_scans(drive: Drive) -> Drive:
    """The drive of a bag, with the ground and clusters that are recorded in it."""
    return replace(drive, scan=recorded_scan)


@dataclass(frozen=True)
class Source:
    """find(i, frame): what was detected in frame i; classes: names of those that it can detect."""

    find: Callable[[int, Frame], Detections]
    classes: frozenset[str] = frozenset(DETECTED)


@dataclass(frozen=True)
class Results:
    """sources by name; tracks as the page has them."""

    sources: Mapping[str, Source] = field(default_factory=dict)
    tracks: tuple[dict[str, Any], ...] = ()

    def layers(self, i: int, frame: Frame, min_score: float) -> dict[str, Any]:
        """Labels and detections of frame i as /api/labels has them, and what of them is missed and
        false from this score on."""
        truth = frame.truth()
        camera = frame.camera() if self.sources and truth is not None else None
        found = {name: source.find(i, frame) for name, source in self.sources.items()}
        matches = {} if truth is None else {
            name: compared(truth, d, min_score, camera, self.sources[name].classes)
            for name, d in found.items()}
        return shown_layers(truth, found, matches)

    def layers_of(self, drive: Drive) -> Callable[[int, float], dict[str, Any]]:
        """layers() of frame i of a drive, from a score on."""
        return lambda i, min_score: self.layers(i, drive.frames[i], min_score)


def shown_layers(truth: GroundTruth | None, found: Mapping[str, Detections],
                 matches: Mapping[str, Any]) -> dict[str, Any]:
    """Labels, and by source its detections, as rows: the box, the class, and the track id or the
    score; of a detection then what each of its own sources says."""
    labels = [] if truth is None else [
        [*map(float, box), name, extra.get("track_id")]
        for box, name, extra in zip(truth.boxes, truth.labels, truth.extras)]
    rows = {}
    for name, d in found.items():
        said = [{k: round(float(v[i]), 3) for k, v in d.sources.items() if np.isfinite(v[i])}
                for i in range(len(d))]
        rows[name] = [[*map(float, box), CLASSES[c], float(score), each]
                      for box, c, score, each in zip(d.boxes, d.class_ids, d.scores, said)]
    return {"labels": labels, "detections": rows, "matches": dict(matches)}


def compared(truth: GroundTruth, found: Detections, min_score: float, camera: Camera | None = None,
             classes: frozenset[str] = frozenset(DETECTED)) -> dict[str, list[int]]:
    """Compare the detections of at least min_score with the labels.

    A hit overlaps by the class's relaxed share in BEV, or is a pedestrian with its centre within
    1 m. All labels are hit, missed or ignored; all these detections are hits, false or ignored.

    Args:
        camera: detections outside its view are ignored, as labels end there.
        classes: classes that can be detected; labels of others are ignored. So are objects that
            only look like one of them, such as a van, and detections on them.

    Returns:
        Row numbers: `missed` and `ignored_labels` of labels, `false` and `ignored` of detections.
    """
    missed, false, hits = [], [], []
    true_names = np.array([SIMILAR[CLASSES[c]] for c in truth.class_ids], object)
    for name in classes & DETECTED.keys():
        alike = np.flatnonzero(true_names == name)
        rows = np.flatnonzero((found.class_ids == CLASSES.index(name))
                              & (found.scores >= min_score))
        boxes, others = found.boxes[rows].astype(np.float64), truth.boxes[alike]
        share = bev_iou(boxes, others)
        hit = share >= DETECTED[name].relaxed
        if name == CLASSES[PEDESTRIAN]:
            far = np.linalg.norm(boxes[:, None, :2] - others[None, :, :2], axis=2)
            hit |= far <= MAX_CENTRE_DISTANCE
        i, j = one_to_one(1.0 - share, hit) if hit.size else (np.zeros(0, int), np.zeros(0, int))
        own = truth.class_ids[alike] == CLASSES.index(name)
        missed += alike[own & ~np.isin(np.arange(len(alike)), j)].tolist()
        hits += rows[i[own[j]]].tolist()
        wrong = np.delete(rows, i)
        if camera is not None and len(wrong):
            wrong = wrong[camera.in_view(found.boxes[wrong, :3])]
        false += wrong.tolist()
    wanted = [CLASSES.index(name) for name in classes & DETECTED.keys()]
    counted = np.flatnonzero(found.scores >= min_score)
    return {"missed": sorted(missed), "false": sorted(false),
            "ignored_labels": np.flatnonzero(~np.isin(truth.class_ids, wanted)).tolist(),
            "ignored": np.setdiff1d(counted, [*hits, *false]).tolist()}


def by_detector(detector: Detector) -> Source:
    """Detects in a frame when it is asked for, once."""
    @lru_cache(maxsize=KEPT)
    def detect(i: int, frame: Frame) -> Detections:
        return detector(frame.load()).detections
    return Source(detect, frozenset(detector.classes))


def by_files(folder: Path) -> Source:
    """KITTI result files, folder/NAME.txt, or those of a run of `detect` in folder; a frame without
    one has no detections. InputError where a file is no result."""
    if not folder.is_dir():
        raise InputError(f"there is no folder {folder} with result files")
    files = find_result_folder(folder)

    @lru_cache(maxsize=KEPT)
    def read(i: int, frame: Frame) -> Detections:
        path = files / f"{frame.name}.txt"
        if not path.exists():
            return Detections.none()
        rows = read_results(path, choose_calibration(frame)[0].lidar_to_camera)
        return Detections.of(rows.boxes, rows.class_ids, [e["score"] for e in rows.extras])
    return Source(read)


def points_topic(path: Path) -> str:
    """The topic of a bag with the clouds that say most: clustered ones, else those of
    bag_frames.cloud_topic. InputError where that is not clear."""
    with Bag(path) as bag:
        known = [topic for topic in CLUSTERED if bag.counts.get(topic)]
        return known[0] if known else choose_cloud_topic(bag)


def recorded(poses: BagPoses, stamps: list[int]) -> Results:
    """What a bag holds beside its clouds, whose poses and stamps are given: detections of every
    node, tracks. A message belongs to the cloud of its stamp. A topic whose boxes nothing connects
    with the clouds' frame is left out, and that is said."""
    bag = poses.handle.bag()
    wanted = {topic for topic, kind in bag.topics.items() if kind == MARKERS and topic != TRUTH
              and topic.endswith((FOUND, TRACKS))}
    found = by_stamp(bag, sorted(wanted))
    numbers = {stamp: i for i, stamp in enumerate(stamps)}
    sources: dict[str, Source] = {}
    tracks: list[dict[str, Any]] = []
    trackers = [topic for topic in found if topic.endswith(TRACKS)]
    for topic, marked in found.items():
        try:
            frames = {numbers[stamp]: poses.to_cloud_frame(each, topic)
                      for stamp, each in marked.items() if stamp in numbers}
        except InputError as error:
            errors.print(f"left out: {error}", style="yellow")
            continue
        if topic in trackers:
            tracks += tracks_of(frames, topic, trackers.index(topic))
        else:
            sources[source_name(topic)] = _given({i: with_sources(f) for i, f in frames.items()})
    return Results(sources, tuple(tracks))


def with_sources(objects: MarkedObjects) -> Detections:
    """Detections from markers, with what each of their sources says where the text has it."""
    said = [e["sources"] if isinstance(e.get("sources"), dict) else {} for e in objects.extras]
    names = list(dict.fromkeys(name for each in said for name in each))[:MOST_SOURCES]
    return replace(to_detections(objects), sources={
        name: np.array([_probability(each.get(name)) for each in said], np.float32)
        for name in names})


def _probability(value: Any) -> float:
    return float(value) if isinstance(value, int | float) and 0 <= value <= 1 else np.nan


def source_name(topic: str) -> str:
    """Of /fused_detector/output/detections the node's name."""
    return topic.strip("/").removesuffix(FOUND)


def _given(found: Mapping[int, Detections]) -> Source:
    classes = {CLASSES[c] for each in found.values() for c in each.class_ids}
    return Source(lambda i, frame: found.get(i, Detections.none()), frozenset(classes))


def recorded_scan(frame: Frame) -> Scan:
    """The cloud of a frame of a bag with the ground and clusters that are recorded in it; those of
    our own where there are none. InputError where it cannot be read."""
    message = frame.native()
    both = {"ground", "cluster_id"} <= {field.name for field in message.fields}
    return scan_in(message, frame.intensity_max()) if both else scanned(frame)


def scan_in(message: Any, intensity_max: float = 0.0, scale: FullScale = infer_full_scale) -> Scan:
    """Return a PointCloud2 with the ground and clusters that it has; none where it has no such
    column. intensity_max, scale: see to_point_cloud. InputError where it is broken."""
    cloud, indices = to_point_cloud(message, intensity_max, scale)
    ground, clusters = read_column(message, "ground", indices), read_cluster_ids(message, indices)
    return scan_of(cloud, np.zeros(len(cloud), bool) if ground is None else ground > 0,
                   np.zeros(len(cloud), np.int32) if clusters is None else clusters[0])


def track_id(tracker: int, number: int) -> int:
    """The page's id of a track: what its tracker calls it, as far as that fits, set apart from
    those of all other trackers; these count from 0."""
    return tracker * APART + number % APART


def tracks_of(frames: Mapping[int, MarkedObjects], topic: str,
              tracker: int) -> list[dict[str, Any]]:
    """What a tracker published, by frame, as the page has tracks; which one of them, see
    track_id."""
    made: dict[int, dict[str, Any]] = {}
    for i in sorted(frames):
        objects = frames[i]
        for box, label, number, score in zip(objects.boxes, objects.labels, objects.ids.tolist(),
                                             objects.scores):
            track = made.setdefault(number, {
                "id": track_id(tracker, number), "class": label, "state": "accepted", "score": 0.0,
                "source": topic.strip("/").split("/")[0], "boxes": [], "uncertainty": 0.0})
            track["class"] = label  # which the tracker knows best at last
            track["score"] = max(track["score"], float(score))
            track["boxes"].append([i, *map(float, box), "proposed"])
    return list(made.values())

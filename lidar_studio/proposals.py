"""Proposed tracks of a drive, from detections and from clusters that are similar to seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lidar_perception.candidates.confidence import compute_confidence
from lidar_perception.candidates.configurations import BEST
from lidar_perception.candidates.silhouette import compute_similarity
from lidar_perception.classes import Size
from lidar_perception.detectors.contract import FUSED
from lidar_perception.geometry import centre_distances
from lidar_perception.tracking.params import MODEL_BY_CLASS_ID, TrackingParams
from lidar_perception.tracking.state import Tracks
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.types import CLASSES, PEDESTRIAN, Detections
from lidar_studio.interpolation import Motion, fill_gaps
from lidar_studio.snap import LONG_OBJECT_M, complete_box, find_usual_size
from lidar_studio.state import PROPOSED, Box, Track
from lidar_studio.survey import FrameSurvey

Array = np.ndarray[Any, Any]
PlacedBox = tuple[Array, str]  # box (7,) and its class
Hit = tuple[int, Array, int, float, bool]  # (frame, box, class id, score, True for a candidate)
SAME_OBJECT_DISTANCE_M = 0.6  # max centre distance of a candidate and a detection of the same person
MIN_CONFIDENCE = 0.3  # minimum confidence of a candidate
UNDETECTED_WEIGHT = 0.5  # weight of the size similarity for objects without a detection
MIN_HITS = 2  # minimum detections of a proposed track, unless there is only one frame
MIN_SCORE = 0.3  # minimum score of a proposed track
PLACED_SCORE = 0.95  # score of a box placed by a person
CANDIDATES = "candidates"  # source of a track without detections
MAX_HIT_DISTANCE_M = 1.0  # maximum distance between a track and the detection that updated it
NO_HIT = -1
# Standard deviations of a cluster's size, as fractions of the seed's length, width or height. Hidden
# parts make a cluster shorter, so a deficit in length counts less than an excess.
LENGTH_EXCESS, LENGTH_DEFICIT, WIDTH_EXCESS, HEIGHT_DEVIATION = 0.12, 0.3, 0.2, 0.12
END_VIEW_PENALTY = 0.5  # deviation added where only the front or rear may be visible
# The tracker reports every track; uncertain ones are dropped at the end.
ALL_TRACKS = TrackingParams(report=0.0, report_unseen=0.0)


@dataclass(frozen=True, eq=False)
class SilhouetteSeed:
    """A pedestrian seed: its silhouette (80,) uint32 and its height in metres."""

    image: Array
    height: float


@dataclass(frozen=True)
class SizeSeed:
    """A seed of another class: a name in CLASSES, and length, width and height in metres."""

    class_name: str
    size: Size


@dataclass(frozen=True)
class ProposalRequest:
    """Seeds of the objects to propose, and the boxes that a person placed, by frame.

    detected: the survey has detections, so that clusters of a seed's size count less.
    """

    seeds: Sequence[SilhouetteSeed] = ()
    sizes: Sequence[SizeSeed] = ()
    placed: Mapping[int, Sequence[PlacedBox]] = field(default_factory=dict)
    detected: bool = False


def compute_likeness(survey: FrameSurvey, seeds: Sequence[SilhouetteSeed]) -> Array:
    """Compute the probability that each cluster is a person, (C,) float64, from its most similar
    seed; 0 without seeds."""
    likeness = np.zeros(len(survey.boxes))
    for seed in seeds if len(survey.boxes) else ():
        similarity = compute_similarity(survey.images, seed.image, BEST.stm)
        likeness = np.maximum(
            likeness, compute_confidence(survey.features, similarity, survey.features["height_m"] - seed.height)
        )
    return likeness


def compute_size_similarity(shapes: Array, size: Size) -> Array:
    """Compute how well clusters fit the visible part of an object of a size, (T,) float64 in 0..1.

    Objects longer than LONG_OBJECT_M may show only their front or rear, so the longer side of a
    cluster may also be the width.

    Args:
        shapes: (T, 7) L-shapes of the clusters, down to the ground.
        size: length, width and height in metres.
    """
    length, width, height = size
    lengths, widths, heights = (shapes[:, k].astype(np.float64) for k in (3, 4, 5))
    excess = lengths / length - 1
    deviation = np.hypot(
        np.where(excess > 0, excess / LENGTH_EXCESS, excess / LENGTH_DEFICIT),
        np.maximum(widths / width - 1, 0) / WIDTH_EXCESS,
    )
    if length > LONG_OBJECT_M:
        deviation = np.minimum(deviation, np.hypot((lengths / width - 1) / WIDTH_EXCESS, END_VIEW_PENALTY))
    return np.exp(-0.5 * (deviation**2 + ((heights / height - 1) / HEIGHT_DEVIATION) ** 2))


def find_objects(
    survey: FrameSurvey, request: ProposalRequest, placed: Sequence[PlacedBox] = ()
) -> tuple[Detections, Array]:
    """Return the objects of a frame, and a mask (K,) bool of the candidates among them.

    Objects are detections, candidates where there is no detection, and boxes that a person placed,
    which replace others at the same place.
    """
    detections, candidates = _add_similar_objects(survey, request, *_find_people(survey, request.seeds))
    for box, name in placed:
        if name in CLASSES:
            distances = centre_distances(detections.boxes, box[None])[:, 0]
            others = distances > max(SAME_OBJECT_DISTANCE_M, box[3] / 3)
            detections = detections[others].concatenate(Detections.of(box, CLASSES.index(name), PLACED_SCORE))
            candidates = np.append(candidates[others], False)
    return detections, candidates


def _find_people(survey: FrameSurvey, seeds: Sequence[SilhouetteSeed]) -> tuple[Detections, Array]:
    scores = compute_likeness(survey, seeds)
    likely = np.flatnonzero(scores >= MIN_CONFIDENCE)
    detections = survey.detections
    people = detections.boxes[np.isin(detections.class_ids, NOT_VEHICLE_IDS)]
    boxes = np.array(
        [complete_box(b, find_usual_size(CLASSES[PEDESTRIAN])) for b in survey.boxes[likely].astype(np.float64)]
    ).reshape(-1, 7)
    is_new = centre_distances(boxes, people).min(axis=1, initial=np.inf) > SAME_OBJECT_DISTANCE_M
    objects = detections.concatenate(Detections.of(boxes[is_new], PEDESTRIAN, scores[likely][is_new]))
    return objects, np.arange(len(objects)) >= len(detections)


def _add_similar_objects(
    survey: FrameSurvey, request: ProposalRequest, detections: Detections, candidates: Array
) -> tuple[Detections, Array]:
    """Add clusters of about the size of a seed, where there is no object."""
    sizes = request.sizes
    if not sizes or not len(survey.shapes):
        return detections, candidates
    scores = np.array([compute_size_similarity(survey.shapes, seed.size) for seed in sizes])
    scores *= UNDETECTED_WEIGHT if request.detected else 1.0
    best_seed = scores.argmax(axis=0)
    likely = np.flatnonzero(scores.max(axis=0) >= MIN_CONFIDENCE)
    shapes = survey.shapes[likely].astype(np.float64)
    boxes = np.array([complete_box(b, sizes[best_seed[k]].size) for k, b in zip(likely, shapes)]).reshape(-1, 7)
    min_distances = np.maximum(SAME_OBJECT_DISTANCE_M, boxes[:, None, 3] / 3)
    is_new = (centre_distances(boxes, detections.boxes) > min_distances).all(axis=1)
    classes = np.array([CLASSES.index(sizes[k].class_name) for k in best_seed[likely]], np.int32)
    objects = detections.concatenate(Detections.of(boxes[is_new], classes[is_new], scores.max(axis=0)[likely][is_new]))
    return objects, np.append(candidates, np.ones(int(is_new.sum()), bool))


NOT_VEHICLE_IDS = [i for i, kind in enumerate(MODEL_BY_CLASS_ID) if kind != MODEL_BY_CLASS_ID[0]]


def propose_tracks(
    surveys: Sequence[FrameSurvey],
    request: ProposalRequest,
    stamps_ns: Sequence[int],
    motion: Motion,
    frames: range,
    on_progress: Callable[[int], bool] = lambda count: True,
) -> list[Track] | None:
    """Return the tracks in consecutive frames of a surveyed drive, the most certain first.

    Args:
        surveys: of all F frames of the drive.
        on_progress: called with the number of finished frames; returns False to cancel.

    Returns:
        Tracks with id 0, or None if cancelled.
    """
    tracker, hits = Tracker(ALL_TRACKS), dict[int, list[Hit]]()
    for i in frames:
        if not on_progress(i - frames.start):
            return None
        objects, candidates = find_objects(surveys[i], request, request.placed.get(i, ()))
        pose = None if motion.poses is None else motion.poses[i]
        tracks = tracker(objects, stamps_ns[i], pose)
        matches = _match_detections(tracks, objects)
        for k in np.flatnonzero(matches != NO_HIT):
            match, box = matches[k], tracks.detections.boxes[k].astype(np.float64)
            box[:3] = objects.boxes[match, :3]
            hits.setdefault(int(tracks.ids[k]), []).append(
                (i, box, int(tracks.detections.class_ids[k]), float(objects.scores[match]), bool(candidates[match]))
            )
    min_hits = min(MIN_HITS, len(frames))
    proposed = [_make_track(rows, motion) for rows in hits.values() if len(rows) >= min_hits]
    return sorted((t for t in proposed if t.score >= MIN_SCORE), key=lambda t: -t.score)


def _match_detections(tracks: Tracks, detections: Detections) -> np.ndarray:
    """Return the detection that updated each track, (K,) int64: the nearest one within
    MAX_HIT_DISTANCE_M, or NO_HIT."""
    if len(detections) == 0:
        return np.full(len(tracks), NO_HIT)
    distances = centre_distances(tracks.detections.boxes, detections.boxes)
    nearest = distances.argmin(axis=1)
    return np.where(tracks.seen & (distances.min(axis=1) <= MAX_HIT_DISTANCE_M), nearest, NO_HIT)


def _make_track(hits: list[Hit], motion: Motion) -> Track:
    frames, boxes, classes, scores, candidates = zip(*hits)
    name = CLASSES[np.bincount(classes, weights=scores).argmax()]
    size = np.median([b[3:6] for b in boxes], axis=0)
    boxes_by_frame = {}
    for frame, box in zip(frames, boxes):
        box[3:6] = size
        boxes_by_frame[frame] = Box.of(np.round(box, 4), PROPOSED)
    source = CANDIDATES if np.mean(candidates) > 0.5 else FUSED
    return Track(0, name, PROPOSED, round(float(np.mean(scores)), 4), source, fill_gaps(boxes_by_frame, motion))

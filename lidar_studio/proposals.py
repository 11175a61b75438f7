"""Proposal of tracks from detections and from clusters that are similar to seeds."""

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
SAME_OBJECT_DISTANCE_M = 0.6  # max distance between the centres of a candidate and a detection of the same person
MIN_CONFIDENCE = 0.3  # minimum confidence of a candidate
UNDETECTED_WEIGHT = 0.5  # factor for the size similarity of clusters that the detector did not detect
MIN_HITS = 2  # minimum number of detections per proposed track, unless there is only one frame
MIN_SCORE = 0.3  # minimum score of a proposed track
PLACED_SCORE = 0.95  # score of a box that a person placed
CANDIDATES = "candidates"  # source of tracks that come mainly from candidates
MAX_HIT_DISTANCE_M = 1.0  # maximum distance between a track and the detection that updated it
NO_HIT = -1
# Standard deviations of a cluster's size, as fractions of the seed's length, width or height. Occlusion
# makes a cluster shorter, so its length may be further below the seed's length than above it.
LENGTH_EXCESS, LENGTH_DEFICIT, WIDTH_EXCESS, HEIGHT_DEVIATION = 0.12, 0.3, 0.2, 0.12
END_VIEW_PENALTY = 0.5  # deviation added if only the front or rear of an object is assumed to be visible
# Make the tracker report all tracks; propose_tracks() drops those with a low score.
ALL_TRACKS = TrackingParams(report=0.0, report_unseen=0.0)


@dataclass(frozen=True, eq=False)
class SilhouetteSeed:
    """Silhouette (80,) uint32 and height (m) of a pedestrian that a person clicked."""

    image: Array
    height: float


@dataclass(frozen=True)
class SizeSeed:
    """Class and size of a clicked object that is not a pedestrian.

    Attributes:
        class_name: Name from CLASSES.
        size: Length, width and height, metres.
    """

    class_name: str
    size: Size


@dataclass(frozen=True)
class ProposalRequest:
    """Seeds of the objects to propose.

    Attributes:
        placed_boxes: Boxes that a person placed, by frame.
        has_detections: True if the survey contains detections, so that clusters of the same size as a seed
            are less likely to be objects.
    """

    silhouette_seeds: Sequence[SilhouetteSeed] = ()
    size_seeds: Sequence[SizeSeed] = ()
    placed_boxes: Mapping[int, Sequence[PlacedBox]] = field(default_factory=dict)
    has_detections: bool = False


def compute_person_probabilities(survey: FrameSurvey, seeds: Sequence[SilhouetteSeed]) -> Array:
    """Compute the probability (C,) float64 that each cluster is a person, from its most similar seed.

    Without seeds, the probability is 0.
    """
    probabilities = np.zeros(len(survey.boxes))
    for seed in seeds if len(survey.boxes) else ():
        similarity = compute_similarity(survey.images, seed.image, BEST.stm)
        height_differences = survey.features["height_m"] - seed.height
        probabilities = np.maximum(probabilities, compute_confidence(survey.features, similarity, height_differences))
    return probabilities


def compute_size_similarity(shapes: Array, size: Size) -> Array:
    """Compute how well clusters match the visible part of an object with a known size.

    Objects longer than LONG_OBJECT_M may show only their front or rear, so the longer side of a
    cluster may also be the width of the object.

    Args:
        shapes: (T, 7) L-shapes of the clusters, which reach down to the ground.
        size: Length, width and height in metres.

    Returns:
        (T,) float64 from 0 to 1.
    """
    length, width, height = size
    lengths, widths, heights = (shapes[:, k].astype(np.float64) for k in (3, 4, 5))
    excess_length = lengths / length - 1
    deviation = np.hypot(
        np.where(excess_length > 0, excess_length / LENGTH_EXCESS, excess_length / LENGTH_DEFICIT),
        np.maximum(widths / width - 1, 0) / WIDTH_EXCESS,
    )
    if length > LONG_OBJECT_M:
        deviation = np.minimum(deviation, np.hypot((lengths / width - 1) / WIDTH_EXCESS, END_VIEW_PENALTY))
    return np.exp(-0.5 * (deviation**2 + ((heights / height - 1) / HEIGHT_DEVIATION) ** 2))


def find_objects(
    survey: FrameSurvey, request: ProposalRequest, placed_boxes: Sequence[PlacedBox] = ()
) -> tuple[Detections, Array]:
    """Return the K objects of a frame, and a mask (K,) bool that is True for candidates.

    Objects are detections, candidates without a detection nearby, and boxes that a person placed.
    Placed boxes replace other objects in the same position.
    """
    objects, is_candidate = _add_similar_objects(survey, request, *_find_people(survey, request.silhouette_seeds))
    for box, name in placed_boxes:
        if name in CLASSES:
            distances = centre_distances(objects.boxes, box[None])[:, 0]
            is_other = distances > max(SAME_OBJECT_DISTANCE_M, box[3] / 3)
            objects = objects[is_other].concatenate(Detections.of(box, CLASSES.index(name), PLACED_SCORE))
            is_candidate = np.append(is_candidate[is_other], False)
    return objects, is_candidate


def _find_people(survey: FrameSurvey, seeds: Sequence[SilhouetteSeed]) -> tuple[Detections, Array]:
    scores = compute_person_probabilities(survey, seeds)
    likely_clusters = np.flatnonzero(scores >= MIN_CONFIDENCE)
    detections = survey.detections
    people = detections.boxes[np.isin(detections.class_ids, NOT_VEHICLE_IDS)]
    boxes = np.array(
        [
            complete_box(b, find_usual_size(CLASSES[PEDESTRIAN]))
            for b in survey.boxes[likely_clusters].astype(np.float64)
        ]
    ).reshape(-1, 7)
    is_new = centre_distances(boxes, people).min(axis=1, initial=np.inf) > SAME_OBJECT_DISTANCE_M
    objects = detections.concatenate(Detections.of(boxes[is_new], PEDESTRIAN, scores[likely_clusters][is_new]))
    return objects, np.arange(len(objects)) >= len(detections)


def _add_similar_objects(
    survey: FrameSurvey, request: ProposalRequest, objects: Detections, is_candidate: Array
) -> tuple[Detections, Array]:
    """Add clusters of about the same size as a seed, where there is no other object."""
    seeds = request.size_seeds
    if not seeds or not len(survey.shapes):
        return objects, is_candidate
    scores = np.array([compute_size_similarity(survey.shapes, seed.size) for seed in seeds])
    scores *= UNDETECTED_WEIGHT if request.has_detections else 1.0
    best_seed = scores.argmax(axis=0)
    likely_clusters = np.flatnonzero(scores.max(axis=0) >= MIN_CONFIDENCE)
    shapes = survey.shapes[likely_clusters].astype(np.float64)
    boxes = np.array([complete_box(b, seeds[best_seed[k]].size) for k, b in zip(likely_clusters, shapes)]).reshape(
        -1, 7
    )
    min_distances = np.maximum(SAME_OBJECT_DISTANCE_M, boxes[:, None, 3] / 3)
    is_new = (centre_distances(boxes, objects.boxes) > min_distances).all(axis=1)
    classes = np.array([CLASSES.index(seeds[k].class_name) for k in best_seed[likely_clusters]], np.int32)
    new_objects = Detections.of(boxes[is_new], classes[is_new], scores.max(axis=0)[likely_clusters][is_new])
    return objects.concatenate(new_objects), np.append(is_candidate, np.ones(int(is_new.sum()), bool))


NOT_VEHICLE_IDS = [i for i, kind in enumerate(MODEL_BY_CLASS_ID) if kind != MODEL_BY_CLASS_ID[0]]


def propose_tracks(
    surveys: Sequence[FrameSurvey],
    request: ProposalRequest,
    stamps_ns: Sequence[int],
    motion: Motion,
    frames: range,
    on_progress: Callable[[int], bool] = lambda count: True,
) -> list[Track] | None:
    """Propose tracks in consecutive frames of a surveyed drive.

    Args:
        surveys: Surveys of all frames of the drive.
        on_progress: Function called with the number of finished frames, which returns False to cancel.

    Returns:
        Tracks with id 0 in order of decreasing score, or None if cancelled.
    """
    tracker, hits = Tracker(ALL_TRACKS), dict[int, list[Hit]]()
    for i in frames:
        if not on_progress(i - frames.start):
            return None
        objects, is_candidate = find_objects(surveys[i], request, request.placed_boxes.get(i, ()))
        pose = None if motion.poses is None else motion.poses[i]
        tracks = tracker(objects, stamps_ns[i], pose)
        matches = _match_detections(tracks, objects)
        for k in np.flatnonzero(matches != NO_HIT):
            match, box = matches[k], tracks.detections.boxes[k].astype(np.float64)
            box[:3] = objects.boxes[match, :3]
            hits.setdefault(int(tracks.ids[k]), []).append(
                (i, box, int(tracks.detections.class_ids[k]), float(objects.scores[match]), bool(is_candidate[match]))
            )
    min_hits = min(MIN_HITS, len(frames))
    all_tracks = [_make_track(rows, motion) for rows in hits.values() if len(rows) >= min_hits]
    return sorted((t for t in all_tracks if t.score >= MIN_SCORE), key=lambda t: -t.score)


def _match_detections(tracks: Tracks, detections: Detections) -> np.ndarray:
    """Return the index (K,) int64 of the detection that updated each track, or NO_HIT.

    It is the nearest detection within MAX_HIT_DISTANCE_M.
    """
    if len(detections) == 0:
        return np.full(len(tracks), NO_HIT)
    distances = centre_distances(tracks.detections.boxes, detections.boxes)
    nearest = distances.argmin(axis=1)
    return np.where(tracks.seen & (distances.min(axis=1) <= MAX_HIT_DISTANCE_M), nearest, NO_HIT)


def _make_track(hits: list[Hit], motion: Motion) -> Track:
    frames, boxes, classes, scores, is_candidate = zip(*hits)
    name = CLASSES[np.bincount(classes, weights=scores).argmax()]
    size = np.median([b[3:6] for b in boxes], axis=0)
    boxes_by_frame = {}
    for frame, box in zip(frames, boxes):
        box[3:6] = size
        boxes_by_frame[frame] = Box.from_array(np.round(box, 4), PROPOSED)
    source = CANDIDATES if np.mean(is_candidate) > 0.5 else FUSED
    return Track(0, name, PROPOSED, round(float(np.mean(scores)), 4), source, fill_gaps(boxes_by_frame, motion))

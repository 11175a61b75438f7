"""Tracks that a person only corrects: what the detector finds and what is like the seeds, followed
through the drive, the surest first."""

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
from lidar_perception.tracking.params import KIND_OF_CLASS, TrackingParams
from lidar_perception.tracking.state import Tracks
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.types import CLASSES, PEDESTRIAN, Detections
from lidar_studio.alike import alike
from lidar_studio.interpolation import Motion, filled
from lidar_studio.snap import completed, usual_size
from lidar_studio.state import PROPOSED, Box, Track
from lidar_studio.survey import Look

Array = np.ndarray[Any, Any]
Placed = tuple[Array, str]  # a box (7,) and its class
SAME = 0.6             # metres between the centres of a candidate and a detection of one person
LEAST_CONFIDENCE = 0.3  # of a candidate
UNDETECTED = 0.5       # share of a likeness that counts where a detector found nothing
FEWEST_HITS = 2        # of a track that is proposed, in a drive of several frames
LEAST_SCORE = 0.3      # of one
SURE = 0.95            # score of a box that a person placed
CANDIDATES = "candidates"  # source of a track that no detector sees
MAX_HIT_DISTANCE_M = 1.0   # between a track and the detection that updated it
NONE = -1
# Every track is reported: which ones are certain is decided when they are complete.
WHOLE = TrackingParams(report=0.0, report_unseen=0.0)


@dataclass(frozen=True, eq=False)
class SeedLook:
    """What candidates are compared with: a silhouette (80,) uint32, and a height in metres."""

    image: Array
    height: float


@dataclass(frozen=True)
class SeedSize:
    """A seed of a class other than Pedestrian: one of CLASSES, and length, width and height."""

    class_name: str
    size: Size


@dataclass(frozen=True)
class Wanted:
    """What is looked for: what is like these seeds; and by frame, all that a person put there.
    detected: a detector looks too, so that what is as large as a seed but not found counts less."""

    seeds: Sequence[SeedLook] = ()
    sizes: Sequence[SeedSize] = ()
    placed: Mapping[int, Sequence[Placed]] = field(default_factory=dict)
    detected: bool = False


def likeness(look: Look, seeds: Sequence[SeedLook]) -> Array:
    """(C,) float64: the probability that each cluster is a person, by the seed it is most like; 0
    without seeds."""
    best = np.zeros(len(look.boxes))
    for seed in seeds if len(look.boxes) else ():
        alike = compute_similarity(look.images, seed.image, BEST.stm)
        best = np.maximum(best, compute_confidence(look.features, alike,
                                                   look.features["height_m"] - seed.height))
    return best


def found_in(look: Look, wanted: Wanted,
             placed: Sequence[Placed] = ()) -> tuple[Detections, Array]:
    """What there is in a frame: detections, and candidates where none is; and which (K,) bool are
    these. What a person placed is there for sure."""
    detections, candidates = _with_things(look, wanted, *_seen_in(look, wanted.seeds))
    for box, name in placed:
        if name in CLASSES:
            others = centre_distances(detections.boxes, box[None])[:, 0] > max(SAME, box[3] / 3)
            sure = Detections.of(box, CLASSES.index(name), SURE)
            detections = detections[others].followed_by(sure)
            candidates = np.append(candidates[others], False)
    return detections, candidates


def _seen_in(look: Look, seeds: Sequence[SeedLook]) -> tuple[Detections, Array]:
    scores = likeness(look, seeds)
    chosen = np.flatnonzero(scores >= LEAST_CONFIDENCE)
    found = look.detections
    people = found.boxes[np.isin(found.class_ids, ON_FOOT)]
    boxes = np.array([completed(b, usual_size(CLASSES[PEDESTRIAN]))
                      for b in look.boxes[chosen].astype(np.float64)]).reshape(-1, 7)
    new = centre_distances(boxes, people).min(axis=1, initial=np.inf) > SAME
    both = found.followed_by(Detections.of(boxes[new], PEDESTRIAN, scores[chosen][new]))
    return both, np.arange(len(both)) >= len(found)


def _with_things(look: Look, wanted: Wanted, found: Detections,
                 candidates: Array) -> tuple[Detections, Array]:
    """Clusters too that are as large as the seeds that are no pedestrians, each like one of them,
    where nothing is found."""
    sizes = wanted.sizes
    if not sizes or not len(look.things):
        return found, candidates
    scores = np.array([alike(look.things, seed.size) for seed in sizes])
    scores *= UNDETECTED if wanted.detected else 1.0
    best = scores.argmax(axis=0)
    chosen = np.flatnonzero(scores.max(axis=0) >= LEAST_CONFIDENCE)
    shapes = look.things[chosen].astype(np.float64)
    boxes = np.array([completed(b, sizes[best[k]].size)
                      for k, b in zip(chosen, shapes)]).reshape(-1, 7)
    apart = np.maximum(SAME, boxes[:, None, 3] / 3)
    new = (centre_distances(boxes, found.boxes) > apart).all(axis=1)
    classes = np.array([CLASSES.index(sizes[k].class_name) for k in best[chosen]], np.int32)
    both = found.followed_by(Detections.of(boxes[new], classes[new],
                                           scores.max(axis=0)[chosen][new]))
    return both, np.append(candidates, np.ones(int(new.sum()), bool))


ON_FOOT = [i for i, kind in enumerate(KIND_OF_CLASS) if kind != KIND_OF_CLASS[0]]


def proposed(looks: Sequence[Look], wanted: Wanted, stamps_ns: Sequence[int], motion: Motion,
             frames: range, told: Callable[[int], bool] = lambda count: True) -> list[Track] | None:
    """The tracks in some frames, one after the other, of a drive of which looks (F) are known, the
    surest first; their ids are 0. told: how many frames are done, says whether to go on; None where
    it does not."""
    tracker, seen = Tracker(WHOLE), dict[int, list[tuple[int, Array, int, float, bool]]]()
    for i in frames:
        if not told(i - frames.start):
            return None
        found, candidates = found_in(looks[i], wanted, wanted.placed.get(i, ()))
        pose = None if motion.poses is None else motion.poses[i]
        tracks = tracker(found, stamps_ns[i], pose)
        by = _hits(tracks, found)
        for k in np.flatnonzero(by != NONE):
            box = tracks.detections.boxes[k].astype(np.float64)
            box[:3] = found.boxes[by[k], :3]
            seen.setdefault(int(tracks.ids[k]), []).append(
                (i, box, int(tracks.detections.class_ids[k]), float(found.scores[by[k]]),
                 bool(candidates[by[k]])))
    fewest = min(FEWEST_HITS, len(frames))
    made = [_track(each, motion) for each in seen.values() if len(each) >= fewest]
    return sorted((t for t in made if t.score >= LEAST_SCORE), key=lambda t: -t.score)


def _hits(tracks: Tracks, found: Detections) -> np.ndarray:
    """Return the detection that updated each track, (K,) int64: the nearest one within
    MAX_HIT_DISTANCE_M, NONE for a track that was not updated."""
    if len(found) == 0:
        return np.full(len(tracks), NONE)
    distances = centre_distances(tracks.detections.boxes, found.boxes)
    nearest = distances.argmin(axis=1)
    return np.where(tracks.seen & (distances.min(axis=1) <= MAX_HIT_DISTANCE_M), nearest, NONE)


def _track(seen: list[tuple[int, Array, int, float, bool]], motion: Motion) -> Track:
    frames, boxes, classes, scores, candidates = zip(*seen)
    name = CLASSES[np.bincount(classes, weights=scores).argmax()]
    size = np.median([b[3:6] for b in boxes], axis=0)
    fixed = {}
    for frame, box in zip(frames, boxes):
        box[3:6] = size
        fixed[frame] = Box.of(np.round(box, 4), PROPOSED)
    source = CANDIDATES if np.mean(candidates) > 0.5 else FUSED
    return Track(0, name, PROPOSED, round(float(np.mean(scores)), 4), source,
                 filled(fixed, motion))

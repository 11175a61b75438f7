"""Tracks that a person only corrects: what the detector finds and what is like the seeds, followed
through the drive, the surest first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lidar_perception.candidates.confidence import confidence
from lidar_perception.candidates.configurations import BEST
from lidar_perception.candidates.silhouette import similarity
from lidar_perception.detectors.contract import FUSED
from lidar_perception.geometry import centre_distances
from lidar_perception.labeling.interpolation import Motion, filled
from lidar_perception.labeling.snap import completed
from lidar_perception.labeling.state import PROPOSED, Box, Track
from lidar_perception.labeling.survey import Look
from lidar_perception.tracking.params import KIND_OF_CLASS, TrackingParams
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.types import CLASSES, PEDESTRIAN, Detections

Array = np.ndarray[Any, Any]
Placed = tuple[Array, str]  # a box (7,) and its class
SAME = 0.6             # metres between the centres of a candidate and a detection of one person
NEAR = 1.0             # metres between a track and the detection that it was hit by
LEAST_CONFIDENCE = 0.3  # of a candidate
FEWEST_HITS = 2        # of a track that is proposed, in a drive of several frames
LEAST_SCORE = 0.3      # of one
SURE = 0.95            # score of a box that a person placed
CANDIDATES = "candidates"  # source of a track that no detector sees
# All that is followed comes out; what is proposed is chosen among whole tracks.
TRACKING = TrackingParams(report=0.0, report_unseen=0.0)


@dataclass(frozen=True, eq=False)
class SeedLook:
    """What candidates are compared with: a silhouette (80,) uint32, and a height in metres."""

    image: Array
    height: float


def likeness(look: Look, seeds: Sequence[SeedLook]) -> Array:
    """(C,) float64: the probability that each cluster is a person, by the seed it is most like; 0
    without seeds."""
    best = np.zeros(len(look.boxes))
    for seed in seeds if len(look.boxes) else ():
        alike = similarity(look.images, seed.image, BEST.stm)
        best = np.maximum(best, confidence(look.features, alike,
                                           look.features["height_m"] - seed.height))
    return best


def found_in(look: Look, seeds: Sequence[SeedLook],
             placed: Placed | None = None) -> tuple[Detections, Array]:
    """What there is in a frame: detections, and candidates where none is; and which (K,) bool are
    these. What a person placed is there for sure."""
    detections, candidates = _seen_in(look, seeds)
    if placed is None or placed[1] not in CLASSES:
        return detections, candidates
    box, name = placed
    others = centre_distances(detections.boxes, box[None])[:, 0] > max(SAME, box[3] / 3)
    kept = detections[others]
    return Detections(np.concatenate([kept.boxes, box[None].astype(np.float32)]),
                      np.append(kept.class_ids, np.int32(CLASSES.index(name))),
                      np.append(kept.scores, np.float32(SURE))), np.append(candidates[others],
                                                                           False)


def _seen_in(look: Look, seeds: Sequence[SeedLook]) -> tuple[Detections, Array]:
    scores = likeness(look, seeds)
    chosen = np.flatnonzero(scores >= LEAST_CONFIDENCE)
    found = look.detections
    people = found.boxes[np.isin(found.class_ids, ON_FOOT)]
    boxes = np.array([completed(b, CLASSES[PEDESTRIAN])
                      for b in look.boxes[chosen].astype(np.float64)]).reshape(-1, 7)
    new = centre_distances(boxes, people).min(axis=1, initial=np.inf) > SAME
    both = Detections(np.concatenate([found.boxes, boxes[new].astype(np.float32)]),
                      np.concatenate([found.class_ids, np.full(new.sum(), PEDESTRIAN, np.int32)]),
                      np.concatenate([found.scores, scores[chosen][new].astype(np.float32)]))
    return both, np.arange(len(both)) >= len(found)


ON_FOOT = [i for i, kind in enumerate(KIND_OF_CLASS) if kind != KIND_OF_CLASS[0]]


def proposed(looks: Sequence[Look], seeds: Sequence[SeedLook], stamps_ns: Sequence[int],
             motion: Motion, placed: Mapping[int, Placed] = {},
             params: TrackingParams = TRACKING) -> list[Track]:
    """The tracks of a drive of which looks (F) are known, the surest first; their ids are 0.
    placed: by frame, boxes that a person put there."""
    tracker, hits = Tracker(params), dict[int, list[tuple[int, Array, int, float, bool]]]()
    for i, look in enumerate(looks):
        found, candidates = found_in(look, seeds, placed.get(i))
        pose = None if motion.poses is None else motion.poses[i]
        tracks = tracker(found, stamps_ns[i], pose)
        for k in np.flatnonzero(tracks.seen):
            box = tracks.detections.boxes[k].astype(np.float64)
            apart = centre_distances(found.boxes, box[None])[:, 0]
            if apart.min(initial=np.inf) > NEAR:
                continue
            nearest = int(apart.argmin())
            box[:3] = found.boxes[nearest, :3]
            hits.setdefault(int(tracks.ids[k]), []).append(
                (i, box, int(tracks.detections.class_ids[k]), float(found.scores[nearest]),
                 bool(candidates[nearest])))
    fewest = min(FEWEST_HITS, len(looks))
    made = [_track(seen, motion) for seen in hits.values() if len(seen) >= fewest]
    return sorted((t for t in made if t.score >= LEAST_SCORE), key=lambda t: -t.score)


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

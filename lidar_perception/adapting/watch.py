"""Is a round an improvement? Simulated scans say it, and frames that were not learned from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from lidar_perception.adapting.hearing import AGREE, Heard
from lidar_perception.adapting.judging import IGNORED, KEPT
from lidar_perception.adapting.labels import ConcludedLabels
from lidar_perception.adapting.looking import FrameLook
from lidar_perception.adapting.params import AdaptParams
from lidar_perception.classes import CLASSES, DETECTED
from lidar_perception.data.frame import Frame
from lidar_perception.detectors.contract import Detector
from lidar_perception.detectors.params import ScoreParams
from lidar_perception.geometry import bev_iou, within
from lidar_perception.runs.terminal import track
from lidar_perception.types import Detections

TOUCHES = 0.05  # overlap with a region that is ignored, from which a detection is not counted


@dataclass(frozen=True)
class Watched:
    """simulated: AP from above on simulated scans, the mean of the classes, and classes: of each;
    agreement, 0..1: F1 of what the network alone detects in single frames that were not learned
    from, with what was kept there when the whole drive was followed before the first round;
    confirmed: share of the detections of all sources together there that no source is against;
    found, kept: boxes."""

    simulated: float
    classes: dict[str, float]
    agreement: float
    confirmed: float
    found: int
    kept: int

    def json(self) -> dict[str, Any]:
        """For a file."""
        return asdict(self)


def worse(before: Watched, after: Watched, params: AdaptParams) -> str:
    """Why a round is not taken, in words; empty if it is."""
    reasons = []
    if after.simulated < before.simulated - params.worse_simulated:
        reasons.append(f"simulated AP fell from {before.simulated:.1f} to {after.simulated:.1f}")
    if after.agreement < before.agreement - params.worse_agreement:
        reasons.append(f"agreement fell from {before.agreement:.2f} to {after.agreement:.2f}")
    if not np.isfinite(after.simulated + after.agreement):
        reasons.append("the scores are no numbers")
    return " and ".join(reasons)


def agreement_of(detector: Detector, frames: Sequence[Frame], labels: Sequence[ConcludedLabels],
                 low: np.ndarray, high: np.ndarray) -> tuple[float, int, int]:
    """F1 of a detector with what is kept in frames, between low and high (2,), metres, and how many
    boxes there were of each; what touches a region that is ignored is not counted. 1 where there is
    nothing."""
    right = found = kept = 0
    for frame, own in track(zip(frames, labels), "judging the network alone", len(frames)):
        boxes = detector.mounted_at(frame.sensor_height)(frame.load()).detections
        counts = _compared(boxes, own, low, high)
        right, found, kept = right + counts[0], found + counts[1], kept + counts[2]
    return (2 * right / (found + kept) if found + kept else 1.0), found, kept


def _compared(boxes: Detections, labels: ConcludedLabels, low: np.ndarray,
              high: np.ndarray) -> tuple[int, int, int]:
    """Boxes that are of one object, all that were found, and all that are kept."""
    kept = labels.of(KEPT) & within(labels.boxes, low, high)
    boxes = boxes[within(boxes.boxes, low, high)]
    taken, right, found = np.zeros(len(labels), bool), 0, 0
    overlaps = bev_iou(boxes.boxes.astype(np.float64), labels.boxes)
    for k in np.argsort(-boxes.scores, kind="stable"):
        name = CLASSES[boxes.class_ids[k]]
        same = kept & ~taken & (labels.class_ids == boxes.class_ids[k])
        best = int(np.where(same, overlaps[k], -1.0).argmax()) if len(labels) else -1
        if best >= 0 and same[best] and overlaps[k, best] >= DETECTED[name].relaxed:
            taken[best], right, found = True, right + 1, found + 1
        elif not (overlaps[k, labels.of(IGNORED)] > TOUCHES).any():
            found += 1
    return right, found, int(kept.sum())


def confirmed_share(looks: Sequence[FrameLook], heard: Heard) -> float:
    """0..1: of the detections of all sources together, at the usual threshold, those that no
    source that is heard is against. 1 without detections."""
    agreed = []
    for look in looks:
        found = look.detections[ScoreParams().passed(look.detections)]
        against = np.zeros(len(found), bool)
        for name, said in found.sources.items():
            asked = np.isin(found.class_ids, [k for k, own in heard.items() if name in own])
            against |= asked & (said < AGREE)
        agreed.append(~against)
    together = np.concatenate(agreed) if agreed else np.zeros(0, bool)
    return float(together.mean()) if len(together) else 1.0

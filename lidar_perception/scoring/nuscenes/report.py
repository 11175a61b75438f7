"""Detections against the labels of nuScenes, frame by frame; content() is what the JSON file holds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from lidar_perception.data.nuscenes.boxes import NAMES, GlobalBoxes
from lidar_perception.data.nuscenes.folder import NuscenesFrame
from lidar_perception.data.nuscenes.results import DETECTED
from lidar_perception.scoring.nuscenes.protocol import ClassScores, class_scores, counted, summary

OURS = tuple(DETECTED.values())


@dataclass
class NuscenesReport:
    """Labels and detections that count, by frame, and what could not be scored; ms of the detector
    by frame, where it was run here."""

    truth: list[GlobalBoxes] = field(default_factory=list)
    found: list[GlobalBoxes] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)

    @property
    def frames(self) -> int:
        return len(self.truth)

    def add(self, frame: NuscenesFrame, found: GlobalBoxes) -> None:
        """A frame that has labels."""
        labels = frame.labels()
        racks = labels.racks()
        self.truth.append(labels.boxes[counted(labels.boxes, frame.ego, racks)])
        self.found.append(found[counted(found, frame.ego, racks)])

    def content(self) -> dict:
        """What the JSON file holds: ap, map and nds in percent. all: the mean over the ten classes,
        as nuScenes ranks detectors; ours: over the three that the package's detectors know."""
        result = {"frames": self.frames, "classes": {}, "all": None, "ours": None,
                  "ms": float(np.median(self.ms)) if self.ms else None, "skipped": self.skipped}
        if self.frames:
            truth, found = (GlobalBoxes.together(parts) for parts in (self.truth, self.found))
            numbers = [np.repeat(np.arange(self.frames), [len(part) for part in parts])
                       for parts in (self.truth, self.found)]
            scores = {name: class_scores(name, truth, numbers[0], found, numbers[1])
                      for name in NAMES}
            result["classes"] = {name: _class_content(s) for name, s in scores.items()}
            result["all"] = _percent(summary(scores))
            result["ours"] = _percent(summary({name: scores[name] for name in OURS}))
        return result


def _class_content(scores: ClassScores) -> dict:
    return {"objects": scores.objects, "detections": scores.detections,
            "ap": {f"{distance:g}": 100 * ap for distance, ap in scores.ap.items()},
            "mean_ap": 100 * scores.mean_ap,
            **{name: None if math.isnan(error) else error for name, error in scores.errors.items()}}


def _percent(figures: dict[str, float]) -> dict[str, float]:
    return {name: 100 * value if name in ("map", "nds") else value
            for name, value in figures.items()}

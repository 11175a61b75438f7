"""Report of nuScenes detection scores for a detector or a result file."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lidar_perception.data.frame import Frame, Recording
from lidar_perception.data.nuscenes.boxes import NAMES, GlobalBoxes
from lidar_perception.data.nuscenes.results import NAME_BY_CLASS, read_results, to_results
from lidar_perception.detectors.contract import Detector
from lidar_perception.scoring.detections import run_detector
from lidar_perception.scoring.nuscenes.protocol import ClassScores, score_class, select_scored_boxes, summarize
from lidar_perception.types import InputError

DETECTED_NAMES = tuple(NAME_BY_CLASS.values())


@dataclass(frozen=True)
class KeyFrameResult:
    """Boxes of one key frame.

    Attributes:
        token: Sample token.
        boxes: All detected boxes, as in a result file.
        truth: Scored labels, None if the frame has no labels.
        detections: Scored detections, None if the frame has no labels.
        ms: Run time of the detector, None for result files.
        problem: Reason why the detector rejected the frame, or None.
    """

    token: str
    boxes: GlobalBoxes
    truth: GlobalBoxes | None
    detections: GlobalBoxes | None
    ms: float | None = None
    problem: str | None = None


def select_boxes(
    frame: Frame, boxes: GlobalBoxes, ms: float | None = None, problem: str | None = None
) -> KeyFrameResult:
    """Select the labels and detections of a nuScenes frame that are scored."""
    key = frame.native
    labels = key.labels()
    if labels is None:
        return KeyFrameResult(key.token, boxes, None, None, ms, problem)
    racks = labels.select_bicycle_racks()
    return KeyFrameResult(
        key.token,
        boxes,
        labels.boxes[select_scored_boxes(labels.boxes, key.ego, racks)],
        boxes[select_scored_boxes(boxes, key.ego, racks)],
        ms,
        problem,
    )


def measure_key_frames(
    open_detector: Callable[[], Detector], include_unlabelled: bool, recording: Recording
) -> Callable[[Frame], KeyFrameResult | None]:
    """Make a function that runs a detector on every key frame with labels.

    partial(measure_key_frames, open_detector, include_unlabelled) is a StartMeasurement of
    scoring.run.

    Args:
        open_detector: Function that loads the detector.
        include_unlabelled: True to run also on key frames without labels.
    """
    detector = open_detector()

    def measure(frame: Frame) -> KeyFrameResult | None:
        if frame.native.labels() is None and not include_unlabelled:
            return None
        result = run_detector(detector, frame, None, None)
        boxes, problem = GlobalBoxes.none(), result.problem
        try:
            boxes = to_results(result.detections, frame)
        except InputError as error:
            problem = str(error)
        return select_boxes(frame, boxes, result.ms, None if problem is None else f"{frame.name}: {problem}")

    return measure


def measure_result_file(path: Path, recording: Recording) -> Callable[[Frame], KeyFrameResult | None]:
    """Make a function that reads the boxes of each labelled key frame from a nuScenes result file.

    partial(measure_result_file, path) is a StartMeasurement of scoring.run.
    """
    boxes = read_results(path, list(recording))
    return lambda frame: None if frame.native.labels() is None else select_boxes(frame, boxes[frame.name])


@dataclass
class NuscenesReport:
    """Labels and detections of all key frames.

    Attributes:
        truth: Scored labels of each frame.
        detections: Scored detections of each frame.
        ms: Run times of the detector; empty for result files.
        skipped: Reasons for skipped frames.
        boxes: All detected boxes by sample token, for a result file.
    """

    truth: list[GlobalBoxes] = field(default_factory=list)
    detections: list[GlobalBoxes] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    boxes: dict[str, GlobalBoxes] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        return len(self.truth)

    def update(self, result: KeyFrameResult) -> None:
        """Add one key frame."""
        self.boxes[result.token] = result.boxes
        if result.problem is not None:
            self.skipped.append(result.problem)
        if result.ms is not None:
            self.ms.append(result.ms)
        if result.truth is not None and result.detections is not None:
            self.truth.append(result.truth)
            self.detections.append(result.detections)

    def compute(self) -> dict:
        """Return the content of the JSON file. ap, map and nds are in percent.

        "all" is the mean over the ten classes, as in nuScenes' ranking. "ours" is the mean over the
        three classes of the package's detectors.
        """
        result = {
            "frames": self.frames,
            "classes": {},
            "all": None,
            "ours": None,
            "ms": float(np.median(self.ms)) if self.ms else None,
            "skipped": self.skipped,
        }
        if self.frames:
            truth, detections = (GlobalBoxes.concatenate(parts) for parts in (self.truth, self.detections))
            frame_indices = [
                np.repeat(np.arange(self.frames), [len(part) for part in parts])
                for parts in (self.truth, self.detections)
            ]
            scores = {name: score_class(name, truth, frame_indices[0], detections, frame_indices[1]) for name in NAMES}
            result["classes"] = {name: _to_class_content(s) for name, s in scores.items()}
            result["all"] = _to_percent(summarize(scores))
            result["ours"] = _to_percent(summarize({name: scores[name] for name in DETECTED_NAMES}))
        return result


def _to_class_content(scores: ClassScores) -> dict:
    return {
        "objects": scores.objects,
        "detections": scores.detections,
        "ap": {f"{distance:g}": 100 * ap for distance, ap in scores.ap.items()},
        "mean_ap": 100 * scores.mean_ap,
        **{name: None if math.isnan(error) else error for name, error in scores.errors.items()},
    }


def _to_percent(scores: dict[str, float]) -> dict[str, float]:
    return {name: 100 * value if name in ("map", "nds") else value for name, value in scores.items()}

"""All detectors of the package on the same frames.

They take turns: each frame begins with another one, so that whatever slows the machine, or warms
its caches, falls on all of them alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from lidar_perception.data.frame import Frame, Recording
from lidar_perception.detectors.contract import Detector
from lidar_perception.scoring.detections import FrameDetections, run_detector
from lidar_perception.scoring.kitti.protocol import DIFFICULTIES, SCORED
from lidar_perception.scoring.kitti.report import ROWS, DetectionReport
from lidar_perception.types import Detections

AP_ROWS = tuple(row for row, (metric, _) in ROWS.items() if metric != "image")


@dataclass(frozen=True)
class Contender:
    """A detector in the comparison.

    detector_of(frame): the detector for a frame, which keeps boxes of low score; None where the
    frame is none of its business. operating: score from which its pedestrians count as detected
    when it is in use. source: its weights, empty without any.
    """

    name: str
    detector_of: Callable[[Frame], Detector | None]
    classes: tuple[str, ...] = SCORED
    operating: float = 0.3
    source: str = ""


def by_contenders(open_: Callable[[], list[Contender]], recording: Recording
                  ) -> Callable[[Frame], dict[str, FrameDetections[Detections]] | None]:
    """Runs every contender that open_() gives on every frame with labels, in turns; gives their
    Detected by name. The first frame is run once more before it counts, as a first run also loads
    what was compiled. With open_ a Start of scoring.run."""
    contenders, state = open_(), {"turn": 0}

    def measure(frame: Frame) -> dict[str, FrameDetections[Detections]] | None:
        truth, calibration = frame.truth(), frame.calibration()
        if truth is None:
            return None
        frame = Frame.of(frame.name, frame.load(), truth, calibration)  # read once for all
        if state["turn"] == 0:
            for contender in contenders:
                _one(contender, frame)
        order = in_turn(contenders, state["turn"])
        state["turn"] += 1
        return {each.name: _one(each, frame) for each in order}
    return measure


def _one(contender: Contender, frame: Frame) -> FrameDetections[Detections]:
    """What a contender says of a frame, without boxes that are not finite."""
    detector = contender.detector_of(frame)
    if detector is None:
        return FrameDetections(frame.name, frame.truth(), Detections.none(), frame.calibration())
    result = run_detector(detector, frame, frame.truth(), frame.calibration())
    boxes, scores = result.detections.boxes, result.detections.scores
    sound = np.isfinite(np.column_stack([boxes, scores])).all(axis=1)
    if sound.all():
        return result
    return replace(result, detections=result.detections[sound],
                   problem=f"{(~sound).sum()} boxes are not finite")


def in_turn(items: list, turn: int) -> list:
    """The items in their order, beginning with another one each turn."""
    begin = turn % max(len(items), 1)
    return items[begin:] + items[:begin]


@dataclass
class ComparisonReport:
    """The report of each contender, by name; drawings: of drives, for intervals, 0 for none;
    follow: as of DetectionReport; skipped: frames that could not be read."""

    contenders: list[Contender]
    reports: dict[str, DetectionReport] = field(init=False)
    drawings: int = 0
    follow: bool = False
    skipped: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.reports = {each.name: DetectionReport(follow=self.follow) for each in self.contenders}

    @property
    def first(self) -> DetectionReport:
        """Whose frames and labels are those of all."""
        return next(iter(self.reports.values()))

    def update(self, results: dict[str, FrameDetections[Detections]]) -> None:
        """One frame."""
        for name, result in results.items():
            self.reports[name].update(result)

    def compute(self) -> dict:
        """What the JSON file holds of the contenders, by name, and of the labels."""
        rows = {each.name: outcome(each, self.reports[each.name], self.drawings)
                for each in self.contenders}
        return {"frames": len(self.first.frames), "objects": objects(self.first), "rows": rows,
                "skipped": self.skipped}


def outcome(contender: Contender, report: DetectionReport, drawings: int = 0) -> dict:
    """As JSON: percent, ms, counts. failed: frames that it refused, with the reason; their objects
    count as missed. intervals: of `drawings` drawings of the drives."""
    ap, centres = report.compute()["ap"], report.pedestrians
    precision = {name: {row: {level: _r40(ap[name][row][level]) for level in DIFFICULTIES}
                        for row in AP_ROWS} if name in contender.classes else None
                 for name in ap}
    scores = {"operating": contender.operating, "best": centres.best_score()}
    intervals = {"intervals": {
        "ap": {name: rows if name in contender.classes else None
               for name, rows in report.intervals(drawings).items()},
        "f1": centres.compute_f1_interval(contender.operating, drawings, report.follow)}
        } if drawings else {}
    return {
        "weights": contender.source, "classes": list(contender.classes),
        "ap": precision, "mean_ap": {row: mean_moderate(precision, row) for row in AP_ROWS},
        "pedestrian_centres": {
            key: {"score": score, **centres.table(np.inf if score is None else score)["all"]}
            for key, score in scores.items()},
        "ms": float(np.median(report.ms)) if report.ms else None,
        "ms_of_frames": [round(ms, 3) for ms in report.ms],
        "frames": len(report.ms), "failed": report.skipped, **intervals}


def objects(report: DetectionReport) -> dict[str, dict[str, int]]:
    """How many labels there are to detect, by class and difficulty; the same for all
    contenders."""
    return {name: {level: row["objects"] if (row := rows["3d"][level]) else 0
                   for level in DIFFICULTIES}
            for name, rows in report.compute()["ap"].items()}


def mean_moderate(precision: dict[str, dict | None], row: str) -> float | None:
    """The mean over the classes with objects; None where a class is not known, or without any."""
    known = [rows[row]["moderate"] for rows in precision.values() if rows is not None]
    values = [value for value in known if value is not None]
    return float(np.mean(values)) if values and len(known) == len(precision) else None


def _r40(level: dict | None) -> float | None:
    return None if level is None else level["r40"]

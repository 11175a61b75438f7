"""Scores and times of all detectors on the same frames.

Detectors take turns: each frame starts with another detector, so that a slow machine or warm caches
affect all of them equally.
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

    Attributes:
        make_detector: Returns the detector for a frame, which keeps boxes of low score; None for a
            frame that it cannot run on.
        operating: Default threshold of its pedestrians.
        source: Its weights; empty without any.
    """

    name: str
    make_detector: Callable[[Frame], Detector | None]
    classes: tuple[str, ...] = SCORED
    operating: float = 0.3
    source: str = ""


def start_comparison(
    open_: Callable[[], list[Contender]], recording: Recording
) -> Callable[[Frame], dict[str, FrameDetections[Detections]] | None]:
    """Return a function that runs every contender on a labelled frame, in turns.

    It returns the results by name, or None for a frame without labels. The first frame is run
    twice and counts once, because a first run also loads compiled code. With open_ bound, this is a
    StartMeasurement of scoring.run.
    """
    contenders, state = open_(), {"turn": 0}

    def measure(frame: Frame) -> dict[str, FrameDetections[Detections]] | None:
        truth, calibration = frame.truth(), frame.calibration()
        if truth is None:
            return None
        frame = Frame.of(frame.name, frame.load(), truth, calibration)  # read once for all detectors
        if state["turn"] == 0:
            for contender in contenders:
                _detect(contender, frame)
        order = rotate(contenders, state["turn"])
        state["turn"] += 1
        return {contender.name: _detect(contender, frame) for contender in order}

    return measure


def _detect(contender: Contender, frame: Frame) -> FrameDetections[Detections]:
    """Run a contender on a frame and drop boxes that are not finite."""
    detector = contender.make_detector(frame)
    if detector is None:
        return FrameDetections(frame.name, frame.truth(), Detections.none(), frame.calibration())
    result = run_detector(detector, frame, frame.truth(), frame.calibration())
    boxes, scores = result.detections.boxes, result.detections.scores
    sound = np.isfinite(np.column_stack([boxes, scores])).all(axis=1)
    if sound.all():
        return result
    return replace(result, detections=result.detections[sound], problem=f"{(~sound).sum()} boxes are not finite")


def rotate(items: list, turn: int) -> list:
    """Return the items in their order, starting with another one each turn."""
    start = turn % max(len(items), 1)
    return items[start:] + items[:start]


@dataclass
class ComparisonReport:
    """The reports of all contenders, by name.

    Attributes:
        resamples: Number of resamples of the drives for intervals; 0 for no intervals.
        sequential: See DetectionReport.
        skipped: Reasons of frames that could not be read.
    """

    contenders: list[Contender]
    reports: dict[str, DetectionReport] = field(init=False)
    resamples: int = 0
    sequential: bool = False
    skipped: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.reports = {contender.name: DetectionReport(sequential=self.sequential) for contender in self.contenders}

    @property
    def first(self) -> DetectionReport:
        """The report of the first contender; frames and labels are the same for all."""
        return next(iter(self.reports.values()))

    def update(self, results: dict[str, FrameDetections[Detections]]) -> None:
        """Add the results of one frame."""
        for name, result in results.items():
            self.reports[name].update(result)

    def compute(self) -> dict:
        """Return the scores of the contenders, by name, and the number of labels, for JSON."""
        rows = {
            contender.name: summarize(contender, self.reports[contender.name], self.resamples)
            for contender in self.contenders
        }
        return {
            "frames": len(self.first.frames),
            "objects": count_labels(self.first),
            "rows": rows,
            "skipped": self.skipped,
        }


def summarize(contender: Contender, report: DetectionReport, resamples: int = 0) -> dict:
    """Return scores in percent, times in ms and counts of a contender, for JSON.

    failed lists frames that the detector refused, with the reason; their objects count as missed.
    intervals are bootstrap intervals of `resamples` resamples of the drives; left out for 0.
    """
    ap, centres = report.compute()["ap"], report.pedestrians
    precision = {
        name: {row: {level: _get_r40(ap[name][row][level]) for level in DIFFICULTIES} for row in AP_ROWS}
        if name in contender.classes
        else None
        for name in ap
    }
    scores = {"operating": contender.operating, "best": centres.find_best_score()}
    intervals = (
        {
            "intervals": {
                "ap": {
                    name: rows if name in contender.classes else None
                    for name, rows in report.compute_intervals(resamples).items()
                },
                "f1": centres.compute_f1_interval(contender.operating, resamples, report.sequential),
            }
        }
        if resamples
        else {}
    )
    return {
        "weights": contender.source,
        "classes": list(contender.classes),
        "ap": precision,
        "mean_ap": {row: compute_mean_moderate(precision, row) for row in AP_ROWS},
        "pedestrian_centres": {
            key: {"score": score, **centres.make_rows(np.inf if score is None else score)["all"]}
            for key, score in scores.items()
        },
        "ms": float(np.median(report.ms)) if report.ms else None,
        "ms_of_frames": [round(ms, 3) for ms in report.ms],
        "frames": len(report.ms),
        "failed": report.skipped,
        **intervals,
    }


def count_labels(report: DetectionReport) -> dict[str, dict[str, int]]:
    """Count the labels by class and difficulty; the same for all contenders."""
    return {
        name: {level: row["objects"] if (row := rows["3d"][level]) else 0 for level in DIFFICULTIES}
        for name, rows in report.compute()["ap"].items()
    }


def compute_mean_moderate(precision: dict[str, dict | None], row: str) -> float | None:
    """Return the mean over the classes; None if the detector lacks a class or there are no labels."""
    known = [rows[row]["moderate"] for rows in precision.values() if rows is not None]
    values = [value for value in known if value is not None]
    return float(np.mean(values)) if values and len(known) == len(precision) else None


def _get_r40(level: dict | None) -> float | None:
    return None if level is None else level["r40"]

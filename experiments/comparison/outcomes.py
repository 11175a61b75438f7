"""Scores and times of all detectors on the same frames.

Each frame starts with a different detector, so that a slow machine or warm caches affect all of them
equally.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import count

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
        make_detector: Function that returns the detector for a frame, which keeps boxes with low
            scores, or None if the detector cannot run on the frame.
        threshold: Default score threshold for pedestrians.
        source: Weights of the detector; empty if it has none.
    """

    name: str
    make_detector: Callable[[Frame], Detector | None]
    classes: tuple[str, ...] = SCORED
    threshold: float = 0.3
    source: str = ""


def start_comparison(
    open_function: Callable[[], list[Contender]], recording: Recording
) -> Callable[[Frame], dict[str, FrameDetections[Detections]] | None]:
    """Return a function that runs every contender on a labelled frame, in rotating order.

    It returns the results by name, or None for a frame without labels. Every contender first runs
    on the first frame without being measured, because its first run also loads compiled code. With
    open_function bound, this is a StartMeasurement of scoring.run.
    """
    contenders, frame_numbers = open_function(), count()

    def measure(frame: Frame) -> dict[str, FrameDetections[Detections]] | None:
        truth, calibration = frame.truth(), frame.calibration()
        if truth is None:
            return None
        frame = Frame.of(frame.name, frame.load(), truth, calibration)  # read once for all detectors
        number = next(frame_numbers)
        if number == 0:
            for contender in contenders:
                _detect(contender, frame)
        return {contender.name: _detect(contender, frame) for contender in rotate(contenders, number)}

    return measure


def _detect(contender: Contender, frame: Frame) -> FrameDetections[Detections]:
    """Run a contender on a frame, and drop boxes with non-finite values."""
    detector = contender.make_detector(frame)
    if detector is None:
        return FrameDetections(frame.name, frame.truth(), Detections.none(), frame.calibration())
    result = run_detector(detector, frame, frame.truth(), frame.calibration())
    boxes, scores = result.detections.boxes, result.detections.scores
    is_finite = np.isfinite(np.column_stack([boxes, scores])).all(axis=1)
    if is_finite.all():
        return result
    return replace(
        result, detections=result.detections[is_finite], problem=f"{(~is_finite).sum()} boxes are not finite"
    )


def rotate(items: list, count: int) -> list:
    """Rotate a list to the left by `count` items."""
    start = count % max(len(items), 1)
    return items[start:] + items[:start]


@dataclass
class ComparisonReport:
    """Reports of all contenders, by name.

    Attributes:
        resamples: Number of resamples of the drives for intervals; 0 for no intervals.
        sequential: See DetectionReport.
        skipped: For each frame that could not be read, the reason.
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
        """The report of the first contender. Its frames and labels are those of all contenders."""
        return next(iter(self.reports.values()))

    def update(self, results: dict[str, FrameDetections[Detections]]) -> None:
        """Add the results of one frame."""
        for name, result in results.items():
            self.reports[name].update(result)

    def compute(self) -> dict:
        """Return the scores of the contenders by name, and the number of labels, as a JSON-serialisable dict."""
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
    """Return scores in percent, times in ms and counts of a contender, as a JSON-serialisable dict.

    `failed` lists the frames that the detector rejected, with the reason; their objects count as
    misses. `intervals` has bootstrap intervals from `resamples` resamples of the drives; it is
    missing if `resamples` is 0.
    """
    ap, centres = report.compute()["ap"], report.pedestrians
    precision = {
        name: {row: {level: _get_r40(ap[name][row][level]) for level in DIFFICULTIES} for row in AP_ROWS}
        if name in contender.classes
        else None
        for name in ap
    }
    scores = {"operating": contender.threshold, "best": centres.find_best_score()}
    intervals = (
        {
            "intervals": {
                "ap": {
                    name: rows if name in contender.classes else None
                    for name, rows in report.compute_intervals(resamples).items()
                },
                "f1": centres.compute_f1_interval(contender.threshold, resamples, report.sequential),
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
    """Count the labels by class and difficulty. They are the same for all contenders."""
    return {
        name: {level: row["objects"] if (row := rows["3d"][level]) else 0 for level in DIFFICULTIES}
        for name, rows in report.compute()["ap"].items()
    }


def compute_mean_moderate(precision: dict[str, dict | None], row: str) -> float | None:
    """Return the mean moderate AP over the classes.

    None if the detector lacks a class, or no class has labels.
    """
    class_values = [rows[row]["moderate"] for rows in precision.values() if rows is not None]
    values = [value for value in class_values if value is not None]
    return float(np.mean(values)) if values and len(class_values) == len(precision) else None


def _get_r40(level: dict | None) -> float | None:
    return None if level is None else level["r40"]

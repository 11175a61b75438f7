"""Comparison of simulated and real scans: points, labelled objects and results of the pipeline.

    compare_scans(measure_scans(real, protocol), measure_scans(simulated, protocol))

Each bin of a curve has the median and the 10 and 90 % quantiles of its samples (scans or objects).
Bins are compared by the ratio of the simulated to the real median. Only bins with MIN_SAMPLES real
samples are judged. A bin is right if its ratio is within RATIO_LIMITS, and wrong if it has no
simulated samples. It is plausible if it is right, or if the simulated median is in the 95 % interval
of the real median.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import binom

from experiments.realism.scan_statistics import (
    CLASSES,
    CURVES,
    SCORES,
    Curve,
    compute_object_rows,
    compute_scan_rows,
    is_full_scan,
)
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.refine import STAGES
from lidar_perception.data.frame import Frame, Recording
from lidar_perception.ground.params import set_sensor_height
from lidar_perception.param_fields import with_values
from lidar_perception.scoring.centres.matching import RANGE_NAMES
from lidar_perception.scoring.centres.report import CandidateReport, measure_frame
from lidar_perception.training.frames import may_have_labels
from lidar_perception.types import InputError

MAX_SCANS = 500  # maximum number of scans; they are evenly spaced in longer recordings
MIN_SAMPLES = 5
RATIO_LIMITS = (0.8, 1.2)


@dataclass
class ScanMeasurements:
    """Measurements of the scans of one recording.

    Attributes:
        rows: Rows of each curve, see scan_statistics.
        report: Scores of the STM-CPA pipeline.
        scans, full_scans: Number of scans, and of those that cover all directions.
        objects: Number of labelled objects by class.
        skipped: For each scan that cannot be read, the reason.
    """

    rows: dict[str, list[np.ndarray]] = field(default_factory=lambda: {c: [] for c in CURVES})
    report: CandidateReport = field(default_factory=CandidateReport)
    scans: int = 0
    full_scans: int = 0
    objects: dict[str, int] = field(default_factory=lambda: dict.fromkeys(CLASSES, 0))
    skipped: list[str] = field(default_factory=list)

    def update(self, frame: Frame, protocol: PipelineParams) -> None:
        """Add one scan. Of a scan that is cropped to a camera's view, only the objects are measured.

        Args:
            frame: The scan.
            protocol: Parameters of the pipeline. The sensor height of the frame is used.

        Raises:
            InputError: The scan cannot be read.
        """
        scan, truth, calibration = frame.load(), frame.truth(), frame.calibration()
        protocol = set_sensor_height(protocol, frame.sensor_height)
        # Sort the points, because the trial planes of the ground threshold depend on their order.
        scan = scan.take(np.lexsort(scan.xyz.T))
        frame = Frame.of(frame.name, scan, truth, calibration)
        self.scans += 1
        if is_full_scan(scan):
            self.full_scans += 1
            self._extend(compute_scan_rows(scan, with_values(protocol, {"view.enabled": False})))
        if truth is not None:
            self._extend(compute_object_rows(scan, truth, frame.camera()))
            for name in truth.labels:
                if name in CLASSES:
                    self.objects[name] += 1
            result = measure_frame(frame, protocol)
            if result is not None:
                self.report.update(result)

    def _extend(self, rows: dict) -> None:
        for curve, values in rows.items():
            self.rows[curve].extend(values)

    def to_dict(self) -> dict:
        """Return the counts as a JSON-serialisable dict."""
        return {
            "scans": self.scans,
            "whole_scans": self.full_scans,
            "objects": self.objects,
            "pedestrian_frames": self.report.frames,
            "skipped": self.skipped,
        }


def select_frames(recording: Recording) -> list[Frame]:
    """Return the frames of a recording, or MAX_SCANS of them, evenly spaced.

    Raises:
        InputError: No scan has labels.
    """
    count = min(len(recording), MAX_SCANS)
    indices = np.linspace(0, len(recording) - 1, count).astype(int)
    frames = [recording.frames[i] for i in indices]
    if not any(map(may_have_labels, frames)):
        raise InputError(
            f"{recording.path} has no labels; give a training folder with label_2 "
            "(object) or label_02 (tracking), or a raw drive with tracklets"
        )
    return frames


def measure_scans(scans: Iterable[Frame], protocol: PipelineParams) -> ScanMeasurements:
    """Measure all curves of the scans. Scans that cannot be read are skipped.

    Raises:
        InputError: No scan can be read.
    """
    measurements = ScanMeasurements()
    for frame in scans:
        try:
            measurements.update(frame, protocol)
        except InputError as error:
            measurements.skipped.append(str(error))
    if measurements.skipped and not measurements.scans:
        raise InputError(f"cannot read any of the {len(measurements.skipped)} scans: {measurements.skipped[0]}")
    return measurements


def compare_scans(real: ScanMeasurements, simulated: ScanMeasurements) -> dict:
    """Compare the curves of real and simulated scans. Return a JSON-serialisable dict."""
    sides = {"real": real, "simulated": simulated}
    tables = {side: measurements.report.compute() for side, measurements in sides.items()}
    curves = {}
    for name, curve in CURVES.items():
        stage, _, score = name.partition(" ")
        columns = [
            _make_score_bins(tables[side].get(stage), score)
            if stage in STAGES
            else _make_bins(measurements.rows[name], curve)
            for side, measurements in sides.items()
        ]
        bins = [_compare_bins(curve, *row) for row in zip(curve.bins, *columns)]
        curves[name] = {"title": curve.title, "axis": curve.axis, **_count_verdicts(bins), "bins": bins}
    all_bins = [b for curve in curves.values() for b in curve["bins"]]
    return {
        **{side: measurements.to_dict() for side, measurements in sides.items()},
        **_count_verdicts(all_bins),
        "curves": curves,
    }


def compute_ratio(simulated: float | None, real: float | None) -> float | None:
    """Return simulated / real: 1 if both are 0, None if one is missing or only real is 0."""
    if simulated is None or real is None:
        return None
    if real == 0.0:
        return 1.0 if simulated == 0.0 else None
    return simulated / real


def compute_factor(bin_row: dict) -> float:
    """Return the factor, at least 1, between the medians of a bin. inf if one is missing or 0."""
    ratio = bin_row["ratio"]
    if not ratio:
        return 1.0 if bin_row["within"] else math.inf
    return max(ratio, 1 / ratio)


def _compare_bins(curve: Curve, name: str, real: dict, simulated: dict) -> dict:
    ratio, is_right, is_plausible = compute_ratio(simulated["median"], real["median"]), None, None
    if real["n"] >= MIN_SAMPLES:
        is_right = is_plausible = ratio is not None and RATIO_LIMITS[0] <= ratio <= RATIO_LIMITS[1]
        if simulated["n"]:
            difference = abs(simulated["median"] - real["median"])
            low, high = real["interval"] or (math.inf, -math.inf)
            is_right = is_right or difference <= curve.step * 1.001
            is_plausible = is_right or low <= simulated["median"] <= high
    return {
        "bin": name,
        "real": real,
        "simulated": simulated,
        "ratio": ratio,
        "within": is_right,
        "plausible": is_plausible,
    }


def _count_verdicts(bins: list[dict]) -> dict:
    verdicts = [b["within"] for b in bins if b["within"] is not None]
    return {
        "within": sum(verdicts),
        "judged": len(verdicts),
        "plausible": sum(b["plausible"] for b in bins if b["within"] is not None),
        "share": sum(verdicts) / len(verdicts) if verdicts else None,
    }


def _make_bins(rows: list[np.ndarray], curve: Curve) -> list[dict]:
    table = np.array(rows, float).reshape(-1, len(curve.bins))
    return [_summarize_bin(column[~np.isnan(column)]) for column in table.T]


def _summarize_bin(values: np.ndarray) -> dict:
    if len(values) == 0:
        return _make_row(0, None)
    low, median, high = np.quantile(values, (0.1, 0.5, 0.9)).tolist()
    return _make_row(len(values), median, low, high, compute_median_interval(values))


def compute_median_interval(values: np.ndarray) -> list[float]:
    """Return the 95 % confidence interval of the median of independent samples (N,).

    Its ends are two of the samples. With fewer than 6 samples it covers slightly less than 95 %.
    """
    rank = max(int(binom.ppf(0.025, len(values), 0.5)) - 1, 0)
    sorted_values = np.sort(values)
    return [float(sorted_values[rank]), float(sorted_values[-1 - rank])]


def _make_row(
    n: int,
    median: float | None,
    low: float | None = None,
    high: float | None = None,
    interval: list[float] | None = None,
) -> dict:
    return {"n": n, "median": median, "low": low, "high": high, "interval": interval}


def _make_score_bins(table: dict | None, score: str) -> list[dict]:
    """Return the bins of a score over all frames. They have no spread; n is the number of cases."""
    counts = [sum(table[name][k] for k in SCORES[score]) if table else 0 for name in (*RANGE_NAMES, "all")]
    return [_make_row(n, table[name][score] if table and n else None) for name, n in zip((*RANGE_NAMES, "all"), counts)]

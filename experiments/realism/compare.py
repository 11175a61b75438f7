"""Simulated against real scans: what a scan, its labelled objects and the pipeline's results are
like, side by side.

    side_by_side(measured_scans(real, protocol), measured_scans(simulated, protocol))

A bin of a curve is the median and the 10 and 90 % quantiles of its samples, the scans or objects.
Two bins are compared by the ratio of their medians, simulated over real. A bin is judged if it has
MIN_SAMPLES real samples, and is right if its ratio is 0.8 .. 1.2; one without simulated samples
is wrong. It is plausible if it is right or the simulated median lies in the 95 % interval of the
real one: few real scans do not say more.
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
    is_whole,
    object_rows,
    scan_rows,
)
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.refine import STAGES
from lidar_perception.data.frame import Frame, Recording
from lidar_perception.ground.params import set_sensor_height
from lidar_perception.param_fields import with_values
from lidar_perception.scoring.centres.matching import RANGE_NAMES
from lidar_perception.scoring.centres.report import CandidateReport, measure_frame
from lidar_perception.types import InputError

MAX_SCANS = 500  # of a folder that are compared; of a larger one, evenly spread
MIN_SAMPLES = 5
WITHIN = (0.8, 1.2)


@dataclass
class Measured:
    """Rows of every curve, of one recording; report has paper A's pipeline, skipped why scans
    could not be read."""

    rows: dict[str, list[np.ndarray]] = field(default_factory=lambda: {c: [] for c in CURVES})
    report: CandidateReport = field(default_factory=CandidateReport)
    scans: int = 0
    whole_scans: int = 0
    objects: dict[str, int] = field(default_factory=lambda: dict.fromkeys(CLASSES, 0))
    skipped: list[str] = field(default_factory=list)

    def update(self, frame: Frame, protocol: PipelineParams) -> None:
        """One scan; protocol is that of the pipeline's scores, for a sensor as high as the frame's.
        A scan that is cropped to the camera's view counts for its objects only. InputError where it
        cannot be read."""
        scan, truth, calibration = frame.load(), frame.truth(), frame.calibration()
        protocol = set_sensor_height(protocol, frame.sensor_height)
        # The threshold's trial planes depend on the order of the points; here nothing shall.
        scan = scan.take(np.lexsort(scan.xyz.T))
        frame = Frame.of(frame.name, scan, truth, calibration)
        self.scans += 1
        if is_whole(scan):
            self.whole_scans += 1
            self._extend(scan_rows(scan, with_values(protocol, {"view.enabled": False})))
        if truth is not None:
            self._extend(object_rows(scan, truth, frame.camera()))
            for name in truth.labels:
                if name in CLASSES:
                    self.objects[name] += 1
            result = measure_frame(frame, protocol)
            if result is not None:
                self.report.update(result)

    def _extend(self, rows: dict) -> None:
        for curve, values in rows.items():
            self.rows[curve].extend(values)

    def content(self) -> dict:
        """Counts for the JSON file."""
        return {"scans": self.scans, "whole_scans": self.whole_scans, "objects": self.objects,
                "pedestrian_frames": self.report.frames, "skipped": self.skipped}


def evenly(recording: Recording) -> list[Frame]:
    """The frames of a recording, or an even choice of MAX_SCANS of them; InputError if no scan has
    labels."""
    count = min(len(recording), MAX_SCANS)
    chosen = np.linspace(0, len(recording) - 1, count).astype(int)
    frames = [recording.frames[i] for i in chosen]
    if not any(map(_may_have_labels, frames)):
        raise InputError(f"{recording.path} has no labels; give the training folder with label_2 "
                         "(object) or label_02 (tracking), or a raw drive with tracklets")
    return frames


def measured_scans(scans: Iterable[Frame], protocol: PipelineParams) -> Measured:
    """Every curve of the scans; those that cannot be read are skipped. InputError if all are."""
    measured = Measured()
    for frame in scans:
        try:
            measured.update(frame, protocol)
        except InputError as error:
            measured.skipped.append(str(error))
    if measured.skipped and not measured.scans:
        raise InputError(f"none of {len(measured.skipped)} scans can be read: "
                         f"{measured.skipped[0]}")
    return measured


def side_by_side(real: Measured, simulated: Measured) -> dict:
    """The curves side by side, as the JSON file holds them."""
    sides = {"real": real, "simulated": simulated}
    tables = {side: measured.report.compute() for side, measured in sides.items()}
    curves = {}
    for name, curve in CURVES.items():
        stage, _, score = name.partition(" ")
        columns = [_score_bins(tables[side].get(stage), score) if stage in STAGES
                   else _bins(measured.rows[name], curve) for side, measured in sides.items()]
        bins = [_compared(curve, *row) for row in zip(curve.bins, *columns)]
        curves[name] = {"title": curve.title, "axis": curve.axis, **_verdict(bins), "bins": bins}
    every = [b for curve in curves.values() for b in curve["bins"]]
    return {**{side: measured.content() for side, measured in sides.items()}, **_verdict(every),
            "curves": curves}


def ratio(simulated: float | None, real: float | None) -> float | None:
    """simulated / real; 1 where both are 0, None where one is missing or only real is 0."""
    if simulated is None or real is None:
        return None
    if real == 0.0:
        return 1.0 if simulated == 0.0 else None
    return simulated / real


def factor_off(bin_row: dict) -> float:
    """By which factor a bin's medians differ, 1 or more, whichever is larger; inf where one of
    them is missing or zero."""
    value = bin_row["ratio"]
    if not value:
        return 1.0 if bin_row["within"] else math.inf
    return max(value, 1 / value)


def _may_have_labels(frame: Frame) -> bool:
    try:
        return frame.truth() is not None
    except InputError:  # what is wrong is reported when the scan is measured
        return True


def _compared(curve: Curve, name: str, real: dict, simulated: dict) -> dict:
    value, within, plausible = ratio(simulated["median"], real["median"]), None, None
    if real["n"] >= MIN_SAMPLES and not curve.histogram:
        within = plausible = value is not None and WITHIN[0] <= value <= WITHIN[1]
        if simulated["n"]:
            off = abs(simulated["median"] - real["median"])
            low, high = real["interval"] or (math.inf, -math.inf)
            within = within or off <= curve.step * 1.001
            plausible = within or low <= simulated["median"] <= high
    return {"bin": name, "real": real, "simulated": simulated, "ratio": value, "within": within,
            "plausible": plausible}


def _verdict(bins: list[dict]) -> dict:
    judged = [b["within"] for b in bins if b["within"] is not None]
    return {"within": sum(judged), "judged": len(judged),
            "plausible": sum(b["plausible"] for b in bins if b["within"] is not None),
            "share": sum(judged) / len(judged) if judged else None}


def _bins(rows: list[np.ndarray], curve: Curve) -> list[dict]:
    table = np.array(rows, float).reshape(-1, len(curve.bins))
    return [_bin_row(column[~np.isnan(column)], curve.histogram) for column in table.T]


def _bin_row(values: np.ndarray, histogram: bool) -> dict:
    """The median of a histogram is its mean, so that its bins add up to 1."""
    if len(values) == 0:
        return _row(0, None)
    if histogram:
        return _row(len(values), float(values.mean()))
    low, median, high = np.quantile(values, (0.1, 0.5, 0.9)).tolist()
    return _row(len(values), median, low, high, median_interval(values))


def median_interval(values: np.ndarray) -> list[float]:
    """The two of the samples (N,) between which the median of what they are drawn from lies, with
    95 % or, of fewer than 6, somewhat less. They must be independent of each other."""
    rank = max(int(binom.ppf(0.025, len(values), 0.5)) - 1, 0)
    ordered = np.sort(values)
    return [float(ordered[rank]), float(ordered[-1 - rank])]


def _row(n: int, median: float | None, low: float | None = None, high: float | None = None,
         interval: list[float] | None = None) -> dict:
    return {"n": n, "median": median, "low": low, "high": high, "interval": interval}


def _score_bins(table: dict | None, score: str) -> list[dict]:
    """Ratios of all frames together, which have no spread; n is the number of cases."""
    counts = [sum(table[name][k] for k in SCORES[score]) if table else 0
              for name in (*RANGE_NAMES, "all")]
    return [_row(n, table[name][score] if table and n else None)
            for name, n in zip((*RANGE_NAMES, "all"), counts)]

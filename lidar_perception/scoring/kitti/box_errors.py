"""Differences between detected and labelled boxes, the effect of correcting each of them, and the
diagnosis of wrong heights."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from rich.console import Console

from lidar_perception.classes import DETECTED
from lidar_perception.geometry import bev_and_3d_iou, horizontal_range, wrap_line
from lidar_perception.scoring.kitti.protocol import METRICS, RELAXED, ComparedFrame
from lidar_perception.scoring.tables import make_table
from lidar_perception.types import CLASSES

RANGES = (0.0, 15.0, 30.0, 45.0, np.inf)  # limits of the ranges in metres
ERRORS = ("away", "aside", "bottom", "length", "width", "height", "yaw")
# name of a correction -> columns of a box that are corrected
CORRECTIONS = {
    "as it is": [],
    "z": [2],
    "x, y": [0, 1],
    "x, y, z": [0, 1, 2],
    "length": [3],
    "width": [4],
    "height": [5],
    "yaw": [6],
}
MIN_BEV_AP = 20.0  # in percent; below this value nothing is diagnosed
MIN_AP_RATIO = 4  # ratio of BEV AP to 3D AP from which heights are diagnosed as wrong
MAX_MEDIAN_ERROR = 0.1  # in metres; a smaller median height error does not count as bias


def match_boxes(frames: list[ComparedFrame], name: str, min_score: float = -np.inf) -> tuple[np.ndarray, np.ndarray]:
    """Return the detected boxes (P, 7) and labelled boxes (P, 7) of a class that match.

    Each label takes the detection of min_score or more that overlaps it most in BEV, if above the
    relaxed overlap.
    """
    class_id, pairs = CLASSES.index(name), [(np.zeros((0, 7)), np.zeros((0, 7)))]
    for frame in frames:
        found = np.flatnonzero((frame.found.class_ids == class_id) & (frame.found.scores >= min_score))
        true = np.flatnonzero(frame.true.class_ids == class_id)
        overlaps = frame.overlaps[METRICS.index("bev")][np.ix_(found, true)]
        matched = np.flatnonzero(overlaps.max(axis=0, initial=0.0) > RELAXED[name])
        best = overlaps[:, matched].argmax(axis=0) if len(matched) else matched
        pairs.append((frame.found.boxes[found[best]], frame.true.boxes[true[matched]]))
    found_boxes, true_boxes = map(np.concatenate, zip(*pairs))
    return found_boxes, true_boxes


def measure_heights(frames: list[ComparedFrame], name: str) -> dict[str, Any]:
    """Measure the height errors of the boxes of a class that match_boxes() matches.

    Returns:
        The number of `pairs`, and medians in metres, None without pairs: `z_error_m`, detected
        minus true centre; `abs_z_error_m`, its absolute value; `height_error_m`, detected minus
        true height; `height_m`, true height.
    """
    found, true = match_boxes(frames, name)
    z, height = found[:, 2] - true[:, 2], true[:, 5]
    rows = {"z_error_m": z, "abs_z_error_m": np.abs(z), "height_error_m": found[:, 5] - height, "height_m": height}
    return {"pairs": len(z), **{key: _compute_median(values) for key, values in rows.items()}}


def diagnose_heights(name: str, rows: dict, matched: dict) -> str:
    """Return one line if class `name` is detected in BEV but not in 3D, else "".

    rows is its average precision in DetectionReport, matched the result of measure_heights().
    """
    for suffix in ("_relaxed", ""):
        bev, full = (rows[metric + suffix]["moderate"] for metric in ("bev", "3d"))
        if matched["pairs"] and bev and bev["r40"] >= MIN_BEV_AP and full["r40"] * MIN_AP_RATIO <= bev["r40"]:
            return (
                f"{name}: AP is {bev['r40']:.1f} in BEV but {full['r40']:.1f} in 3D "
                f"(moderate, overlap {rows['bev' + suffix]['overlap']}): heights are wrong. "
                + _describe_heights(matched)
            )
    return ""


def _describe_heights(matched: dict) -> str:
    z, taller, height = (matched[key] for key in ("z_error_m", "height_error_m", "height_m"))
    boxes = f"the {matched['pairs']} matched boxes are"
    if abs(z) < MAX_MEDIAN_ERROR:
        return (
            f"In the median {boxes} {matched['abs_z_error_m']:.2f} m too high or too low, and "
            f"{abs(taller):.2f} m too {'tall' if taller > 0 else 'flat'}."
        )
    reason = "check the sensor height and the frame of the boxes."
    if abs(abs(z) - height / 2) < MAX_MEDIAN_ERROR:
        reason = "that is half their height: z is probably the bottom of a box, not its centre."
    return f"In the median {boxes} {abs(z):.2f} m too {'high' if z > 0 else 'low'}; {reason}"


def measure_box_errors(frames: list[ComparedFrame], name: str, min_score: float) -> dict[str, Any]:
    """Compare the boxes of a class that match_boxes() matches.

    Returns:
        by_range: for each of RANGES and for all: number of `pairs`, and of each error the `median`
            and the `median_size` (of absolute values), m and rad. Errors are detected minus true:
            centre along the ray from the sensor (away) and to its left (aside), bottom, sizes, and
            yaw modulo half a turn.
        strict: for each of CORRECTIONS the percentage of pairs beyond the strict overlap in 3D
            (`space`) and BEV (`above`), None without pairs.
    """
    found, true = match_boxes(frames, name, min_score)
    differences, away = _compute_differences(found, true), horizontal_range(true)
    bands = {
        f"{low:g}-{high:g} m".replace("-inf m", " m -"): (away >= low) & (away < high) for low, high in pairwise(RANGES)
    } | {"all": np.ones(len(true), bool)}
    return {
        "min_score": min_score,
        "by_range": {
            title: {
                "pairs": int(own.sum()),
                **{
                    error: {"median": _compute_median(values[own]), "median_size": _compute_median(np.abs(values[own]))}
                    for error, values in differences.items()
                },
            }
            for title, own in bands.items()
        },
        "strict": {
            title: _measure_overlaps(found, true, columns, DETECTED[name].strict)
            for title, columns in CORRECTIONS.items()
        },
    }


def _compute_differences(found: np.ndarray, true: np.ndarray) -> dict[str, np.ndarray]:
    azimuth = np.arctan2(true[:, 1], true[:, 0])
    x, y, z, *sizes, yaw = (found - true).T
    return dict(
        zip(
            ERRORS,
            (
                np.cos(azimuth) * x + np.sin(azimuth) * y,
                np.cos(azimuth) * y - np.sin(azimuth) * x,
                z - sizes[2] / 2,
                *sizes,
                wrap_line(yaw),
            ),
        )
    )


def _measure_overlaps(
    found: np.ndarray, true: np.ndarray, columns: list[int], min_overlap: float
) -> dict[str, float | None]:
    """Return the percentage of pairs above min_overlap with these columns of `found` corrected."""
    if len(found) == 0:
        return {"space": None, "above": None}
    boxes = found.copy()
    boxes[:, columns] = true[:, columns]
    bev, full = np.array([[iou[0, 0] for iou in bev_and_3d_iou(a[None], b[None])] for a, b in zip(boxes, true)]).T
    return {"space": 100 * float((full > min_overlap).mean()), "above": 100 * float((bev > min_overlap).mean())}


def _compute_median(values: np.ndarray) -> float | None:
    return float(np.median(values)) if len(values) else None


def print_box_errors(errors: dict[str, dict[str, Any]], console: Console) -> None:
    """Print two tables for each class with pairs."""
    for name, content in errors.items():
        if content["by_range"]["all"]["pairs"] == 0:
            continue
        table = make_table(
            f"{name}: detected minus true, median, and median of absolute values", "", "pairs", *ERRORS, width=6
        )
        for title, row in content["by_range"].items():
            table.add_row(title, str(row["pairs"]), *(_format(row[e]["median"], "+.2f") for e in ERRORS))
            table.add_row("", "", *(_format(row[e]["median_size"], ".2f") for e in ERRORS), style="dim")
        table.caption = (
            f"Metres, yaw in radians; boxes with a score of {content['min_score']:g} "
            "or more. away, aside: of the centre, along the ray from the sensor and "
            "to its left."
        )
        console.print(table)
        table = make_table(
            f"{name}: pairs beyond the overlap {DETECTED[name].strict:g}, %", "corrected", *CORRECTIONS, width=7
        )
        for view, title in (("space", "3D"), ("above", "BEV")):
            table.add_row(title, *(f"{row[view]:.0f}" for row in content["strict"].values()))
        console.print(table)


def _format(value: float | None, spec: str) -> str:
    return "" if value is None else format(value, spec)

"""Differences between detected and labelled boxes, and the effect of correcting each of them."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from rich.console import Console

from lidar_perception.classes import DETECTED
from lidar_perception.geometry import bev_and_3d_iou, horizontal_range, wrap_line
from lidar_perception.scoring.kitti.matched_heights import match_boxes
from lidar_perception.scoring.kitti.protocol import ComparedFrame
from lidar_perception.scoring.tables import make_table

RANGES = (0.0, 15.0, 30.0, 45.0, np.inf)  # metres
ERRORS = ("away", "aside", "bottom", "length", "width", "height", "yaw")
# name of a correction -> columns of a box that are corrected
CORRECTIONS = {"as it is": [], "z": [2], "x, y": [0, 1], "x, y, z": [0, 1, 2], "length": [3],
               "width": [4], "height": [5], "yaw": [6]}


def measure_box_errors(frames: list[ComparedFrame], name: str, min_score: float) -> dict[str, Any]:
    """Compare the labels of a class with the detections that overlap them most in BEV.

    Pairs need more than the relaxed overlap of the class, and detections at least min_score.

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
    bands = {f"{low:g}-{high:g} m".replace("-inf m", " m -"): (away >= low) & (away < high)
             for low, high in pairwise(RANGES)} | {"all": np.ones(len(true), bool)}
    return {
        "min_score": min_score,
        "by_range": {
            title: {
                "pairs": int(own.sum()),
                **{
                    error: {
                        "median": _compute_median(values[own]),
                        "median_size": _compute_median(np.abs(values[own])),
                    }
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
    """Compute the differences (P,) by ERRORS."""
    azimuth = np.arctan2(true[:, 1], true[:, 0])
    x, y, z, *sizes, yaw = (found - true).T
    return dict(zip(ERRORS, (np.cos(azimuth) * x + np.sin(azimuth) * y,
                             np.cos(azimuth) * y - np.sin(azimuth) * x, z - sizes[2] / 2, *sizes,
                             wrap_line(yaw))))


def _measure_overlaps(found: np.ndarray, true: np.ndarray, columns: list[int],
                      least: float) -> dict[str, float | None]:
    """Return the percentage of pairs above the overlap with these columns corrected."""
    if len(found) == 0:
        return {"space": None, "above": None}
    boxes = found.copy()
    boxes[:, columns] = true[:, columns]
    above, space = np.array([[iou[0, 0] for iou in bev_and_3d_iou(a[None], b[None])]
                             for a, b in zip(boxes, true)]).T
    return {"space": 100 * float((space > least).mean()),
            "above": 100 * float((above > least).mean())}


def _compute_median(values: np.ndarray) -> float | None:
    return float(np.median(values)) if len(values) else None


def print_box_errors(errors: dict[str, dict[str, Any]], console: Console) -> None:
    """Print two tables for each class with pairs."""
    for name, content in errors.items():
        if content["by_range"]["all"]["pairs"] == 0:
            continue
        table = make_table(f"{name}: detected minus true, median, and median of absolute values",
                           "", "pairs", *ERRORS, width=6)
        for title, row in content["by_range"].items():
            table.add_row(
                title, str(row["pairs"]), *(_format_signed(row[e]["median"]) for e in ERRORS)
            )
            table.add_row(
                "", "", *(_format_size(row[e]["median_size"]) for e in ERRORS), style="dim"
            )
        table.caption = (f"Metres, yaw in radians; boxes with a score of {content['min_score']:g} "
                         "or more. away, aside: of the centre, along the ray from the sensor and "
                         "to its left.")
        console.print(table)
        table = make_table(f"{name}: pairs beyond the overlap {DETECTED[name].strict:g}, %",
                           "corrected", *CORRECTIONS, width=7)
        for view, title in (("space", "3D"), ("above", "BEV")):
            table.add_row(title, *(f"{row[view]:.0f}" for row in content["strict"].values()))
        console.print(table)


def _format_signed(value: float | None) -> str:
    return "" if value is None else f"{value:+.2f}"


def _format_size(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"

"""Errors of detected boxes, and a diagnosis of height errors."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from rich.console import Console

from lidar_perception.geometry import horizontal_range, wrap_line
from lidar_perception.scoring.kitti.protocol import METRICS, RELAXED, ComparedFrame
from lidar_perception.scoring.tables import make_table
from lidar_perception.types import CLASSES

RANGES = (0.0, 15.0, 30.0, 45.0, np.inf)  # limits of the range bins in metres
ERRORS = ("away", "aside", "bottom", "length", "width", "height", "yaw")
MIN_SCORE = 0.2  # minimum score of the boxes to analyse
MIN_BEV_AP = 20.0  # minimum BEV AP for a diagnosis, in percent
MIN_AP_RATIO = 4  # ratio of BEV AP to 3D AP above which wrong heights are suspected
MAX_MEDIAN_ERROR = 0.1  # maximum median height error without bias, in metres


def match_boxes(frames: list[ComparedFrame], name: str, min_score: float = -np.inf) -> tuple[np.ndarray, np.ndarray]:
    """Match the detections and labels of a class.

    Each label matches the detection with the highest BEV IoU, if the IoU exceeds the relaxed overlap.
    Detections below min_score are ignored.

    Returns:
        Detected boxes (P, 7) and labelled boxes (P, 7) of the matches.
    """
    class_id, pairs = CLASSES.index(name), [(np.zeros((0, 7)), np.zeros((0, 7)))]
    for frame in frames:
        detections = np.flatnonzero((frame.detections.class_ids == class_id) & (frame.detections.scores >= min_score))
        labels = np.flatnonzero(frame.labels.class_ids == class_id)
        overlaps = frame.overlaps[METRICS.index("bev")][np.ix_(detections, labels)]
        matched_labels = np.flatnonzero(overlaps.max(axis=0, initial=0.0) > RELAXED[name])
        best_detections = overlaps[:, matched_labels].argmax(axis=0) if len(matched_labels) else matched_labels
        pairs.append((frame.detections.boxes[detections[best_detections]], frame.labels.boxes[labels[matched_labels]]))
    detected_boxes, true_boxes = map(np.concatenate, zip(*pairs))
    return detected_boxes, true_boxes


def measure_heights(frames: list[ComparedFrame], name: str) -> dict[str, Any]:
    """Measure the height errors of the matched boxes of a class; see match_boxes.

    Returns:
        pairs: Number of matches.
        z_error_m: Median of detected minus labelled z of the centre, metres.
        abs_z_error_m: Median absolute error of z, metres.
        height_error_m: Median of detected minus labelled height.
        height_m: Median of the labelled height.

        The medians are None without matches.
    """
    detected_boxes, label_boxes = match_boxes(frames, name)
    z_error, height = detected_boxes[:, 2] - label_boxes[:, 2], label_boxes[:, 5]
    rows = {
        "z_error_m": z_error,
        "abs_z_error_m": np.abs(z_error),
        "height_error_m": detected_boxes[:, 5] - height,
        "height_m": height,
    }
    return {"pairs": len(z_error), **{key: _compute_median(values) for key, values in rows.items()}}


def diagnose_heights(name: str, rows: dict, height_errors: dict) -> str:
    """Return a one-line diagnosis if a class is detected in BEV but not in 3D, otherwise "".

    Args:
        name: Name of the class.
        rows: Average precision of the class, as in DetectionReport.
        height_errors: Result of measure_heights.
    """
    for suffix in ("_relaxed", ""):
        bev, three_d = (rows[metric + suffix]["moderate"] for metric in ("bev", "3d"))
        if height_errors["pairs"] and bev and bev["r40"] >= MIN_BEV_AP and three_d["r40"] * MIN_AP_RATIO <= bev["r40"]:
            return (
                f"{name}: AP is {bev['r40']:.1f} in BEV but {three_d['r40']:.1f} in 3D "
                f"(moderate, overlap {rows['bev' + suffix]['overlap']}): heights are wrong. "
                + _describe_heights(height_errors)
            )
    return ""


def _describe_heights(height_errors: dict) -> str:
    z_error, height_error, height = (height_errors[key] for key in ("z_error_m", "height_error_m", "height_m"))
    boxes = f"The {height_errors['pairs']} matched boxes are"
    if abs(z_error) < MAX_MEDIAN_ERROR:
        return (
            f"{boxes} {height_errors['abs_z_error_m']:.2f} m too high or too low, and {abs(height_error):.2f} m too "
            f"{'tall' if height_error > 0 else 'short'} (medians)."
        )
    reason = "check the sensor height and the frame of the boxes."
    if abs(abs(z_error) - height / 2) < MAX_MEDIAN_ERROR:
        reason = "that is half their height: z is probably the bottom of a box, not its centre."
    return f"{boxes} {abs(z_error):.2f} m too {'high' if z_error > 0 else 'low'} (median); {reason}"


def measure_box_errors(frames: list[ComparedFrame], name: str, min_score: float = MIN_SCORE) -> dict[str, Any]:
    """Measure the errors of the matched boxes of a class; see match_boxes.

    Returns:
        by_range: For each range and for "all": number of `pairs`, and for each of ERRORS its
            `median` and `median_size` (median of absolute values), in metres and radians. Errors
            are detected minus labelled: centre along the ray from the sensor (away) and to the left
            of the ray (aside), bottom, length, width, height, and yaw modulo pi.
    """
    detected_boxes, label_boxes = match_boxes(frames, name, min_score)
    differences, ranges = _compute_differences(detected_boxes, label_boxes), horizontal_range(label_boxes)
    masks = {
        f"{low:g}-{high:g} m".replace("-inf m", " m -"): (ranges >= low) & (ranges < high)
        for low, high in pairwise(RANGES)
    } | {"all": np.ones(len(label_boxes), bool)}
    return {
        "min_score": min_score,
        "by_range": {
            title: {
                "pairs": int(mask.sum()),
                **{
                    error: {
                        "median": _compute_median(values[mask]),
                        "median_size": _compute_median(np.abs(values[mask])),
                    }
                    for error, values in differences.items()
                },
            }
            for title, mask in masks.items()
        },
    }


def _compute_differences(detected_boxes: np.ndarray, label_boxes: np.ndarray) -> dict[str, np.ndarray]:
    azimuth = np.arctan2(label_boxes[:, 1], label_boxes[:, 0])
    x, y, z, *sizes, yaw = (detected_boxes - label_boxes).T
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


def _compute_median(values: np.ndarray) -> float | None:
    return float(np.median(values)) if len(values) else None


def print_box_errors(errors: dict[str, dict[str, Any]], console: Console) -> None:
    """Print a table for each class with matched boxes."""
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
            "or more. away, aside: error of the centre along the ray from the sensor, "
            "and to the left of it."
        )
        console.print(table)


def _format(value: float | None, spec: str) -> str:
    return "" if value is None else format(value, spec)

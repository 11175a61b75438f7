"""Height errors of matched boxes, and the diagnosis of a low 3D AP that they explain."""

from __future__ import annotations

import numpy as np

from lidar_perception.scoring.kitti.protocol import METRICS, RELAXED, ComparedFrame
from lidar_perception.types import CLASSES

MIN_BEV_AP = 20.0     # percent; below this nothing is diagnosed
MIN_AP_RATIO = 4   # of BEV to 3D AP from which on heights are wrong
MAX_MEDIAN_ERROR = (
    0.1  # metres; below this the median is not biased
)


def measure_heights(frames: list[ComparedFrame], name: str) -> dict:
    """Measure the height errors of a class.

    Each label is paired with the detection that overlaps it most in BEV, above the relaxed overlap.

    Returns:
        pairs: number of pairs.
        z_error_m, abs_z_error_m: median height of the detected centre above the true one, and of
            its absolute value.
        height_error_m: median of detected minus true height.
        height_m: median true height.

    Medians are None without pairs.
    """
    found, true = match_boxes(frames, name)
    z, taller, height = found[:, 2] - true[:, 2], found[:, 5] - true[:, 5], true[:, 5]
    rows = {"z_error_m": z, "abs_z_error_m": np.abs(z), "height_error_m": taller,
            "height_m": height}
    return {"pairs": len(z),
            **{key: float(np.median(v)) if len(z) else None for key, v in rows.items()}}


def match_boxes(frames: list[ComparedFrame], name: str,
                min_score: float = -np.inf) -> tuple[np.ndarray, np.ndarray]:
    """Return the detected boxes (P, 7) and labelled boxes (P, 7) of a class that match.

    Each label takes the detection of min_score or more that overlaps it most in BEV, if above the
    relaxed overlap.
    """
    class_id, pairs = CLASSES.index(name), []
    for frame in frames:
        found = np.flatnonzero((frame.found.class_ids == class_id)
                               & (frame.found.scores >= min_score))
        true = np.flatnonzero(frame.true.class_ids == class_id)
        overlaps = frame.overlaps[METRICS.index("bev")][np.ix_(found, true)]
        matched = np.flatnonzero(overlaps.max(axis=0, initial=0.0) > RELAXED[name])
        best = overlaps[:, matched].argmax(axis=0) if len(matched) else matched
        pairs.append((frame.found.boxes[found[best]], frame.true.boxes[true[matched]]))
    none = np.zeros((0, 7))
    return (np.concatenate([none, *(found for found, _ in pairs)]),
            np.concatenate([none, *(true for _, true in pairs)]))


def diagnose_heights(name: str, rows: dict, matched: dict) -> str:
    """Return one line if a class is detected in BEV but not in 3D, else "".

    Args:
        name: name of the class.
        rows: its part of the report.
        matched: result of measure_heights.
    """
    for suffix in ("_relaxed", ""):
        bev, space = (rows[metric + suffix]["moderate"] for metric in ("bev", "3d"))
        if (matched["pairs"] and bev and bev["r40"] >= MIN_BEV_AP
                and space["r40"] * MIN_AP_RATIO <= bev["r40"]):
            return (f"{name}: AP is {bev['r40']:.1f} in BEV but {space['r40']:.1f} in 3D "
                    f"(moderate, overlap {rows['bev' + suffix]['overlap']}): heights are wrong. "
                    + _describe_heights(matched))
    return ""


def _describe_heights(matched: dict) -> str:
    z, taller, height = (matched[key] for key in ("z_error_m", "height_error_m", "height_m"))
    boxes = f"the {matched['pairs']} matched boxes are"
    if abs(z) < MAX_MEDIAN_ERROR:
        return (f"In the median {boxes} {matched['abs_z_error_m']:.2f} m too high or too low, and "
                f"{abs(taller):.2f} m too {'tall' if taller > 0 else 'flat'}.")
    reason = "check the sensor height and the frame of the boxes."
    if abs(abs(z) - height / 2) < MAX_MEDIAN_ERROR:
        reason = "that is half their height: z is probably the bottom of a box, not its centre."
    return f"In the median {boxes} {abs(z):.2f} m too {'high' if z > 0 else 'low'}; {reason}"

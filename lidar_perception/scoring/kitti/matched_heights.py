"""How high found boxes hang beside the true ones, and when that explains a bad score in space."""

from __future__ import annotations

import numpy as np

from lidar_perception.scoring.kitti.protocol import METRICS, RELAXED, ComparedFrame
from lidar_perception.types import CLASSES

GOOD_BEV = 20.0     # percent AP from above from which the score in space is looked at
LOST_IN_SPACE = 4   # times lower in space than from above: heights are off
SCATTER = 0.1       # metres of median error below which boxes are not too high or low as a whole


def matched_heights(frames: list[ComparedFrame], name: str) -> dict:
    """pairs: true objects of the class called name with the found box that overlaps them most from
    above (relaxed overlap). z_error_m, abs_z_error_m: median height of the found centre above the
    true one, and of its absolute value; height_error_m: median of found height minus true height;
    height_m: median true height. None without pairs."""
    errors = [_pairs(frame, CLASSES.index(name), RELAXED[name]) for frame in frames]
    z, taller, height = np.concatenate([np.zeros((3, 0)), *errors], axis=1)
    rows = {"z_error_m": z, "abs_z_error_m": np.abs(z), "height_error_m": taller,
            "height_m": height}
    return {"pairs": len(z),
            **{key: float(np.median(v)) if len(z) else None for key, v in rows.items()}}


def _pairs(frame: ComparedFrame, class_id: int, least: float) -> np.ndarray:
    """(3, P) centre error, error of the height, true height."""
    overlaps = frame.overlaps[METRICS.index("bev")]
    overlaps = np.where((frame.found.class_ids == class_id)[:, None], overlaps, 0)
    overlaps = overlaps[:, frame.true.class_ids == class_id]
    if overlaps.size == 0:
        return np.zeros((3, 0))
    matched = overlaps.max(axis=0) > least
    found = frame.found.boxes[overlaps.argmax(axis=0)[matched]]
    true = frame.true.boxes[frame.true.class_ids == class_id][matched]
    return np.stack([found[:, 2] - true[:, 2], found[:, 5] - true[:, 5], true[:, 5]])


def heights_off(name: str, rows: dict, matched: dict) -> str:
    """One line where the class called name is found from above but not in space, at the relaxed or
    the strict overlap; else ''. rows: its part of the report; matched: of matched_heights."""
    for suffix in ("_relaxed", ""):
        bev, space = (rows[metric + suffix]["moderate"] for metric in ("bev", "3d"))
        if (matched["pairs"] and bev and bev["r40"] >= GOOD_BEV
                and space["r40"] * LOST_IN_SPACE <= bev["r40"]):
            return (f"{name}: AP is {bev['r40']:.1f} from above but {space['r40']:.1f} in space "
                    f"(moderate, overlap {rows['bev' + suffix]['overlap']}): heights are off. "
                    + _how_far_off(matched))
    return ""


def _how_far_off(matched: dict) -> str:
    z, taller, height = (matched[key] for key in ("z_error_m", "height_error_m", "height_m"))
    boxes = f"the {matched['pairs']} matched boxes are"
    if abs(z) < SCATTER:
        return (f"By the median {boxes} {matched['abs_z_error_m']:.2f} m too high or too low, and "
                f"{abs(taller):.2f} m too {'tall' if taller > 0 else 'flat'}.")
    reason = "check the height of the sensor, and the frame of the boxes."
    if abs(abs(z) - height / 2) < SCATTER:
        reason = "that is half their height: is z the bottom of a box and not its centre?"
    return f"By the median {boxes} {abs(z):.2f} m too {'high' if z > 0 else 'low'}; {reason}"

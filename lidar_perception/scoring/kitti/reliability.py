"""Whether a score is the share of its boxes that are right (Guo et al., ICML 2017)."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import Console

from lidar_perception.classes import DETECTED
from lidar_perception.scoring.kitti.protocol import Comparison, hits_and_wrong
from lidar_perception.scoring.tables import narrow_table

EDGES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)  # scores, where bins begin


def reliability(frames: Comparison, name: str) -> dict[str, Any]:
    """Of the class called name, hard difficulty, from above at the relaxed overlap: by bin of EDGES
    the number of `boxes` and the percentage `right`, None without boxes; `error`, the mean gap
    between the middle of a bin and the share of its boxes that are right, weighted by boxes, in
    percent. Boxes that KITTI's protocol ignores do not count; a second box of one object is
    wrong."""
    at_least = hits_and_wrong(frames, name, "bev", DETECTED[name].relaxed, "hard",
                              np.array(EDGES))
    hits, wrong = (np.maximum(-np.diff(np.append(count, 0.0)), 0.0) for count in at_least)
    boxes = hits + wrong
    right = hits / np.maximum(boxes, 1)
    middles = (np.array(EDGES) + np.append(EDGES[1:], 1.0)) / 2
    return {"bins": [{"from": edge, "boxes": int(count),
                      "right": 100 * float(share) if count else None}
                     for edge, count, share in zip(EDGES, boxes, right)],
            "error": 100 * float((boxes * np.abs(right - middles)).sum() / boxes.sum())
            if boxes.any() else None}


def print_reliability(scores: dict[str, dict[str, Any]], console: Console) -> None:
    """One table of all classes."""
    table = narrow_table("Of the boxes with such a score so many are right, %", "score from",
                         *(f"{edge:g}" for edge in EDGES), "error", width=5)
    for name, content in scores.items():
        table.add_row(name, *("" if row["right"] is None else f"{row['right']:.0f}"
                              for row in content["bins"]),
                      "" if content["error"] is None else f"{content['error']:.0f}")
        table.add_row("  boxes", *(str(row["boxes"]) for row in content["bins"]), style="dim")
    table.caption = ("From above at the relaxed overlap. error: mean gap to the middle of the bin, "
                     "weighted by boxes.")
    console.print(table)

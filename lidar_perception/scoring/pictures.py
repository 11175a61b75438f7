"""Pictures of frames, from above."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from lidar_perception.geometry import box_corners
from lidar_perception.types import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRUTH_COLOR, FOUND_COLOR, TRACK_COLOR = "#009e73", "#d55e00", "#7b2d8b"


def draw_frame(path: str | Path, xyz: np.ndarray, ground: np.ndarray, cluster_ids: np.ndarray,
               truth: np.ndarray, found: np.ndarray, *,
               trails: Mapping[int, np.ndarray] = MappingProxyType({}), title: str = "",
               max_range: float = 45.0) -> None:
    """Write a PNG of one frame: ground grey, clusters coloured, true boxes (M, 7) green, found
    boxes (K, 7) orange, trails (N, 3) of tracks purple with their ids at the end. x (forward)
    points up, y (left) to the left, metres."""
    import matplotlib
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(9, 9), dpi=120)
    other = ~ground & (cluster_ids == 0)
    for mask, color, size in ((ground, "#d9d9d9", 0.3), (other, "#8c8c8c", 0.3)):
        axes.scatter(-xyz[mask, 1], xyz[mask, 0], s=size, c=color, linewidths=0)
    clustered = cluster_ids > 0
    # Neighbouring ids get different colours.
    axes.scatter(-xyz[clustered, 1], xyz[clustered, 0], s=1.2, linewidths=0, cmap="tab20",
                 c=cluster_ids[clustered] * 7 % 20, vmin=0, vmax=19)
    for boxes, color, label in ((truth, TRUTH_COLOR, "labelled"),
                                (found, FOUND_COLOR, "found")):
        for i, corners in enumerate(box_corners(np.asarray(boxes, float).reshape(-1, 7))[:, :4]):
            closed = corners[[0, 1, 2, 3, 0]]
            axes.plot(-closed[:, 1], closed[:, 0], color=color, linewidth=1.6,
                      label=label if i == 0 else None)
    for i, (number, trail) in enumerate(trails.items()):
        axes.plot(-trail[:, 1], trail[:, 0], color=TRACK_COLOR, linewidth=2.2,
                  label="track" if i == 0 else None)
        axes.annotate(str(number), (-trail[-1, 1], trail[-1, 0]), (5, 5), color=TRACK_COLOR,
                      textcoords="offset points", fontsize=10, fontweight="bold",
                      annotation_clip=True)
    axes.plot(0, 0, marker="^", color="black", markersize=8)
    forward = xyz[np.abs(xyz[:, :2]).max(axis=1) < max_range, 0] if len(xyz) else np.zeros(1)
    # Where only the camera's view is processed there is nothing behind to show.
    lowest = -2.0 if not cluster_ids[xyz[:, 0] < 0].any() else forward.min(initial=0)
    axes.set(xlim=(-max_range / 1.6, max_range / 1.6), ylim=(lowest, max_range), aspect="equal",
             xlabel="right [m]", ylabel="forward [m]", title=title)
    axes.grid(color="#eeeeee", linewidth=0.5)
    axes.set_axisbelow(True)
    if len(truth) or len(found) or trails:
        axes.legend(loc="upper right", framealpha=0.9)
    save_picture(path, figure, bbox_inches="tight")


def save_picture(path: str | Path, figure: Figure, **options) -> None:
    """Write a figure as PNG and close it. InputError where it cannot be written."""
    import matplotlib.pyplot as plt
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, format="png", **options)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None
    finally:
        plt.close(figure)

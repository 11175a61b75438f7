"""Pictures of what is kept, rejected and ignored, from above, as PNG bytes."""

from __future__ import annotations

from io import BytesIO

import numpy as np

from lidar_perception.adapting.judging import IGNORED, KEPT, REJECTED
from lidar_perception.adapting.labels import ConcludedLabels
from lidar_perception.geometry import box_corners

COLORS = {KEPT: "#009e73", IGNORED: "#e69f00", REJECTED: "#d55e00"}  # Okabe and Ito, 2008
MAX_DRAWN = 60_000  # points
SIZE = 8.0          # inches
CONCLUDED = "--"    # line of boxes that are concluded from other frames


def drawn(xyz: np.ndarray, labels: ConcludedLabels, low: np.ndarray, high: np.ndarray) -> bytes:
    """One frame between low and high (2,), metres: points (N, 3), and boxes with their numbers;
    dashed what was not detected in this frame. x points up, y to the left."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width, height = high[1] - low[1], high[0] - low[0]
    figure = Figure(figsize=(SIZE, SIZE * height / width + 0.4), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    shown = xyz[::max(1, len(xyz) // MAX_DRAWN)]
    axes.scatter(-shown[:, 1], shown[:, 0], s=0.4, c="#8c8c8c", linewidths=0)
    for state, color in COLORS.items():
        for k in np.flatnonzero(labels.of(state)):
            corners = box_corners(labels.boxes[k:k + 1])[0, [0, 1, 2, 3, 0]]
            axes.plot(-corners[:, 1], corners[:, 0], color=color, linewidth=1.4,
                      linestyle="-" if labels.seen[k] else CONCLUDED)
            axes.annotate(str(labels.numbers[k]), (-corners[0, 1], corners[0, 0]), color=color,
                          fontsize=7, annotation_clip=True)
        axes.plot([], [], color=color, label=f"{state}: {labels.of(state).sum()}")
    axes.plot(0, 0, marker="^", color="black", markersize=7)
    axes.set(xlim=(-high[1], -low[1]), ylim=(low[0], high[0]), aspect="equal",
             xlabel="right (m)", ylabel="ahead (m)")
    axes.legend(loc="upper right", fontsize=8)
    stream = BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()

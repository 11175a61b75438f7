"""Tables and figure of the comparison of all detectors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.text import Text

from experiments.comparison.outcomes import AP_ROWS
from lidar_perception.scoring.average_precision import MIN_OBJECTS
from lidar_perception.scoring.intervals import INTERVAL_PERCENT
from lidar_perception.scoring.kitti.protocol import RELAXED, SCORED, STRICT
from lidar_perception.scoring.kitti.report import INTERVALS
from lidar_perception.scoring.kitti.tables import CENTRE_F1
from lidar_perception.scoring.pictures import save_picture
from lidar_perception.scoring.tables import (
    format_counts,
    format_interval,
    format_number,
    format_percent,
    make_table,
    print_skipped,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SHORT_NAMES = {"bev": "BEV", "3d": "3D", "bev_relaxed": "BEV", "3d_relaxed": "3D"}
FAMILIES = {  # prefix of a name -> colour (Okabe and Ito, 2008) and marker; the first match is used
    "STM-CPA +": ("#cc79a7", "D"),
    "PP ": ("#cc79a7", "D"),
    "STM-CPA": ("#009e73", "s"),
    "PointPillars": ("#0072b2", "o"),
    "PointNet": ("#d55e00", "^"),
    "fused": ("#000000", "*"),
}


def print_comparison(content: dict, console: Console) -> None:
    """Print average precision, pedestrian scores by centre distance, times and missing detectors."""
    _print_precision(content, console)
    _print_pedestrians(content, console)
    _print_intervals(content, console)
    for reason in dict.fromkeys(row["reason"] for row in content["missing"]):
        names = [row["name"] for row in content["missing"] if row["reason"] == reason]
        console.print(Text("missing", "yellow") + f": {', '.join(names)}: {reason}", soft_wrap=False)
    failures = [f"{name}: {line}" for name, row in content["rows"].items() for line in row["failed"]]
    print_skipped([*content["skipped"], *failures], console)


def _print_precision(content: dict, console: Console) -> None:
    titles = [title for name in SCORED for title in (name[:3], "", "", "")]
    table = make_table(f"AP (R40, moderate), {content['frames']} frames", "", *titles, width=5)
    table.add_row("", *(SHORT_NAMES[row] for _ in SCORED for row in AP_ROWS), style="dim")
    table.add_row(
        "overlap above",
        *(f"{(RELAXED if 'relaxed' in row else STRICT)[name]:g}" for name in SCORED for row in AP_ROWS),
        style="dim",
        end_section=True,
    )
    for name, row in content["rows"].items():
        table.add_row(
            name,
            *(
                format_number(None if row["ap"][kind] is None else row["ap"][kind][overlap]["moderate"])
                for kind in SCORED
                for overlap in AP_ROWS
            ),
        )
    labels = {name: content["objects"][name]["moderate"] for name in SCORED}
    table.caption = (
        "Labels: "
        + ", ".join(f"{name} {n}{'*' * (0 < n < MIN_OBJECTS)}" for name, n in labels.items())
        + (
            ". * too few for KITTI's 40 recall points, so AP is the area under the complete curve. "
            "-: the detector does not support the class, or there are no labels."
        )
    )
    console.print(table)


def _print_pedestrians(content: dict, console: Console) -> None:
    centres = content["pedestrians"]
    table = make_table(
        f"Pedestrians within 1.0 m ({centres['ground_truth']} in {centres['frames']} frames), and time per frame",
        "",
        "score",
        "TP",
        "FP",
        "FN",
        "prec.",
        "recall",
        "F1",
        "best",
        "from",
        "ms",
        "runs",
        "failed",
        width=4,
    )
    for name, row in content["rows"].items():
        at_default, at_best = (row["pedestrian_centres"][key] for key in ("operating", "best"))
        table.add_row(
            name,
            f"{at_default['score']:.2f}",
            *format_counts(at_default, "tp", "fp", "fn"),
            *format_percent(at_default, "precision", "recall", "f1"),
            *format_percent(at_best, "f1"),
            format_number(at_best["score"]),
            format_number(row["ms"]),
            str(row["frames"]),
            str(len(row["failed"])),
        )
    table.add_section()
    for name, f1 in CENTRE_F1.items():
        table.add_row(f"paper: {name}", *[""] * 6, f"{100 * f1:.1f}", style="dim")
    table.caption = (
        "score: the default threshold. best: the highest F1 at any threshold on these labels; from: that threshold. "
        "ms: median over frames. STM-CPA takes its seed from the labels, so it runs "
        "only on frames with a pedestrian; `auto` finds the seed itself. The paper's values "
        "are for its 1779 frames."
    )
    console.print(table)


def _print_intervals(content: dict, console: Console) -> None:
    rows = {name: row["intervals"] for name, row in content["rows"].items() if "intervals" in row}
    if not rows:
        return
    metrics = INTERVALS[0], INTERVALS[-1]
    table = make_table(
        f"{INTERVAL_PERCENT} % intervals, resampled by drive",
        "",
        *(f"{name[:3]} {SHORT_NAMES[row]}" for name in SCORED for row in metrics),
        "F1",
        width=7,
    )
    table.add_row(
        "overlap above",
        *(f"{(RELAXED if 'relaxed' in row else STRICT)[name]:g}" for name in SCORED for row in metrics),
        style="dim",
        end_section=True,
    )
    for name, intervals in rows.items():
        table.add_row(
            name,
            *(
                format_interval(intervals["ap"][kind] and intervals["ap"][kind][row])
                for kind in SCORED
                for row in metrics
            ),
            format_interval(intervals["f1"]),
        )
    table.caption = "AP: moderate labels. F1: pedestrians at the default threshold."
    console.print(table)


def draw_comparison(path: str | Path, content: dict) -> None:
    """Write a PNG of pedestrian F1 and mean 3D AP against time per frame.

    Raises:
        InputError: The file cannot be written.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = {name: row for name, row in content["rows"].items() if row["ms"] is not None}
    centres = content["pedestrians"]
    figure, (left, right) = plt.subplots(1, 2, figsize=(15, 6.4), dpi=120, layout="constrained")
    _draw(
        left,
        {
            name: (
                row["ms"],
                100 * row["pedestrian_centres"]["operating"]["f1"],
                100 * row["pedestrian_centres"]["best"]["f1"],
            )
            for name, row in rows.items()
        },
        "filled: default threshold, hollow: best threshold",
        left_margin=0.31,
    )
    left.set(
        title=f"F1 of {centres['ground_truth']} pedestrians in {centres['frames']} frames", ylabel="F1 within 1.0 m [%]"
    )
    for value in dict.fromkeys(round(100 * f1) for f1 in CENTRE_F1.values()):
        names = [name for name, f1 in CENTRE_F1.items() if round(100 * f1) == value]
        left.axhline(value, color="#bbbbbb", linewidth=0.8, linestyle=":", zorder=0)
        left.annotate(
            f"paper: {', '.join(names)}",
            (0.01, value),
            fontsize=7,
            color="#888888",
            xycoords=("axes fraction", "data"),
            va="bottom",
        )
    _draw(
        right,
        {
            name: (row["ms"], row["mean_ap"]["3d"], row["mean_ap"]["3d_relaxed"])
            for name, row in rows.items()
            if row["mean_ap"]["3d"] is not None
        },
        "filled: overlap 0.7 (Car) and 0.5, hollow: 0.5 and 0.25",
    )
    right.set(title=f"Mean 3D AP, moderate, {content['frames']} frames", ylabel="mean AP of three classes [%]")
    save_picture(path, figure)


def _draw(axes: Axes, points: dict[str, tuple[float, float, float]], legend: str, left_margin: float = 0.0) -> None:
    """Draw points (ms, value, other value) on a logarithmic time axis, with their names at the right.

    Args:
        axes: Matplotlib axes.
        points: Points by name.
        legend: Meaning of filled and hollow markers.
        left_margin: Fraction of the axis that is kept free at the left.
    """
    axes.set(xscale="log", xlabel=f"ms per frame, median ({legend})", ylim=(-3, 103))
    axes.grid(color="#eeeeee", which="both", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    if not points:
        text = "no detector supports all three classes"
        axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", color="#888888")
        return
    ms = [x for x, _, _ in points.values()]
    low, high = min(ms) / 1.6, max(ms) * 1.6
    axes.set_xlim(low / (high / low) ** (left_margin / (1 - left_margin)), high)
    axes.xaxis.set_major_locator(_make_ticks(*axes.get_xlim()))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    heights = spread_heights([y for _, y, _ in points.values()], -2, 102, 4.0)
    for (name, (x, y, other_y)), height in zip(points.items(), heights):
        color, marker = next(style for prefix, style in FAMILIES.items() if name.startswith(prefix))
        axes.plot([x, x], [y, other_y], color=color, linewidth=0.8, alpha=0.6)
        axes.plot(x, other_y, marker, color=color, markerfacecolor="white", markersize=6)
        axes.plot(x, y, marker, color=color, markersize=6)
        axes.annotate(
            f"{name}  {y:.1f}",
            (x, y),
            (1.03, height),
            fontsize=8,
            color=color,
            textcoords=("axes fraction", "data"),
            va="center",
            annotation_clip=False,
            arrowprops=dict(
                arrowstyle="-", color=color, linewidth=0.4, alpha=0.5, relpos=(0, 0.5), shrinkA=1, shrinkB=3
            ),
        )


def _make_ticks(low: float, high: float):
    from matplotlib.ticker import FixedLocator

    steps = (1, 2, 5) if high < 1e3 * low else (1, 3)  # tick positions whose labels do not overlap
    return FixedLocator(
        [step * 10.0**power for power in range(-3, 7) for step in steps if low <= step * 10.0**power <= high]
    )


def spread_heights(values: Sequence[float], low: float, high: float, gap: float) -> np.ndarray:
    """Return heights (N,) close to the values (N,), in the same order and between low and high.

    They are at least `gap` apart, or less if there is not enough room for all. N is at least 1.
    """
    from sklearn.isotonic import isotonic_regression

    count = len(values)
    gap = min(gap, (high - low) / max(count - 1, 1))
    order, heights = np.argsort(values, kind="stable"), np.empty(count)
    # After the gaps are subtracted, the heights only need to be non-decreasing.
    level = isotonic_regression(np.asarray(values, float)[order] - gap * np.arange(count))
    heights[order] = np.clip(level, low, high - gap * (count - 1)) + gap * np.arange(count)
    return heights

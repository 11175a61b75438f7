"""Tables of the comparison of all detectors."""

from __future__ import annotations

from rich.console import Console
from rich.text import Text

from experiments.comparison.outcomes import AP_ROWS
from lidar_perception.scoring.average_precision import MIN_OBJECTS
from lidar_perception.scoring.intervals import INTERVAL_PERCENT
from lidar_perception.scoring.kitti.protocol import RELAXED, SCORED, STRICT
from lidar_perception.scoring.kitti.report import INTERVALS
from lidar_perception.scoring.kitti.tables import CENTRE_F1
from lidar_perception.scoring.tables import (
    format_counts,
    format_interval,
    format_number,
    format_percent,
    make_table,
    print_skipped,
)

SHORT_NAMES = {"bev": "BEV", "3d": "3D", "bev_relaxed": "BEV", "3d_relaxed": "3D"}


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

"""Tables of detection scores."""

from __future__ import annotations

from rich.console import Console

from lidar_perception.scoring.average_precision import MIN_OBJECTS
from lidar_perception.scoring.intervals import INTERVAL_PERCENT
from lidar_perception.scoring.kitti.protocol import DIFFICULTIES
from lidar_perception.scoring.kitti.report import INTERVALS
from lidar_perception.scoring.tables import (
    format_counts,
    format_interval,
    format_number,
    format_percent,
    make_table,
    print_skipped,
    print_time,
)

# Tables 6 and 7 of the STM-CPA paper: F1 of pedestrians within 1.0 m.
CENTRE_F1 = {"STM-CPA": 0.521, "PointPillars": 0.52, "AVOD": 0.48, "PointCNN": 0.37, "F-PointNet": 0.33}
TITLES = {"image": "2D box", "aos": "orientation", "bev": "BEV", "3d": "3D", "bev_relaxed": "BEV", "3d_relaxed": "3D"}


def print_detection_report(content: dict, console: Console) -> None:
    """Print average precision by class and difficulty, pedestrian scores, and the diagnosis."""
    _print_precision(content, console)
    _print_centres(content["pedestrian_centres"], console)
    for line in content["diagnosis"]:
        console.print(line, style="yellow")
    print_time(content["ms"], console)
    print_skipped(content["skipped"], console)


def _print_precision(content: dict, console: Console) -> None:
    table = make_table(
        f"KITTI average precision, {content['frames']} frames", "", "overlap", "", "R40", "", "", "R11", "", width=6
    )
    table.add_row("", "", *("easy", "mod.", "hard") * 2, style="dim")
    for name, rows in content["ap"].items():
        objects = [level["objects"] if level else 0 for level in _list_levels(rows["3d"])]
        table.add_row(name, "", *(f"{n}{'*' * (0 < n < MIN_OBJECTS)}" for n in objects), "", "", "", style="bold")
        for row, title in TITLES.items():
            if row in rows:
                overlap = rows["image" if row == "aos" else row]["overlap"]
                table.add_row(
                    f"  {title}",
                    f"{overlap:g}",
                    *(_format_cell(level, key) for key in ("r40", "r11") for level in _list_levels(rows[row])),
                )
        table.add_section()
    table.caption = (
        "Next to the class: number of labels by difficulty. *: too few for KITTI's "
        "sampling of recall; the full curve is used instead."
    )
    console.print(table)
    if mean_ap := content["map_3d"]:
        console.print(f"3D AP, mean of classes and difficulties: R40 {mean_ap['r40']:.2f}, R11 {mean_ap['r11']:.2f}")


def print_intervals(content: dict[str, dict], console: Console) -> None:
    """Print the AP intervals of DetectionReport.compute_intervals."""
    table = make_table(
        f"{INTERVAL_PERCENT} % intervals of AP (R40, moderate), bootstrap over drives",
        "",
        *(TITLES[row] + overlap for row, overlap in zip(INTERVALS, (", relaxed", "", ""))),
        width=10,
    )
    for name, rows in content.items():
        table.add_row(name, *(format_interval(rows[row]) for row in INTERVALS))
    console.print(table)


def _print_centres(centres: dict, console: Console) -> None:
    if centres["ground_truth"] == 0:
        return
    table = make_table(
        f"Pedestrians within 1.0 m: {centres['ground_truth']} in {centres['frames']} frames",
        "detections",
        "TP",
        "FP",
        "FN",
        "prec.",
        "recall",
        "F1",
        width=7,
    )
    rows = {"all": centres["of_all"]["all"]}
    if centres["best_score"] is not None:
        rows[f"score {centres['best_score']:.3g} or more"] = centres["at_best_score"]["all"]
    for title, row in rows.items():
        table.add_row(title, *format_counts(row, "tp", "fp", "fn"), *format_percent(row, "precision", "recall", "f1"))
    table.caption = "F1 in the STM-CPA paper: " + ", ".join(f"{name} {100 * f1:.1f}" for name, f1 in CENTRE_F1.items())
    console.print(table)


def _list_levels(row: dict) -> list[dict | None]:
    return [row[level] for level in DIFFICULTIES]


def _format_cell(level: dict | None, key: str) -> str:
    return format_number(None if level is None else level[key])

"""Table of nuScenes detection scores, with the results of a paper."""

from __future__ import annotations

from rich.console import Console

from lidar_perception.scoring.nuscenes.protocol import DISTANCES, ERRORS
from lidar_perception.scoring.nuscenes.report import DETECTED_NAMES
from lidar_perception.scoring.tables import format_number, make_table, print_skipped, print_time

# The improved-PointNet paper on nuScenes. It does not state the split, the classes, AOE, AVE or AAE.
PAPER = {"map": 92.68, "ate": 0.298, "ase": 0.218, "nds": 83.45}


def print_nuscenes_report(content: dict, console: Console) -> None:
    """Print the AP at each distance and the errors, for each class and overall."""
    table = make_table(
        f"nuScenes detection, {content['frames']} frames",
        "",
        "labels",
        *(f"{d:g}m" for d in DISTANCES),
        "mAP",
        *(e.upper() for e in ERRORS),
        "NDS",
        width=4,
    )
    for name, row in content["classes"].items():
        table.add_row(
            name.replace("construction_vehicle", "constr. veh.").replace("_", " "),
            str(row["objects"]),
            *(f"{ap:.3g}" for ap in row["ap"].values()),
            format_number(row["mean_ap"]),
            *_format_errors(row),
            style="" if name in DETECTED_NAMES else "dim",
        )
    table.add_section()
    for key, title in ("all", "all ten"), ("ours", "our three"):
        objects = sum(
            row["objects"] for name, row in content["classes"].items() if key == "all" or name in DETECTED_NAMES
        )
        table.add_row(title, str(objects), *[""] * len(DISTANCES), *_format_summary(content[key]), style="bold")
    table.add_row("the paper", "", *[""] * len(DISTANCES), *_format_summary(PAPER), style="dim")
    table.caption = (
        "AP in percent by centre distance; ATE m, ASE 1 - IoU, AOE rad, AVE m/s, AAE 1 - accuracy. "
        "A class that is not detected has AP 0 and errors 1. Our three: car, pedestrian, bicycle "
        "(our Cyclist); nuScenes does not rank this mean. Without velocities and attributes AVE and "
        "AAE are 1, and NDS is 80 at most. The paper names neither its classes nor its split."
    )
    console.print(table)
    print_time(content["ms"], console)
    print_skipped(content["skipped"], console)


def _format_summary(row: dict) -> list[str]:
    return [format_number(row["map"]), *_format_errors(row), format_number(row["nds"])]


def _format_errors(row: dict) -> list[str]:
    return [format_number(row.get(name), width=4) for name in ERRORS]

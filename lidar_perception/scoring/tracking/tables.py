"""Tables of tracking scores."""

from __future__ import annotations

from rich.console import Console
from rich.text import Text

from lidar_perception.scoring.tables import make_table, print_skipped

SCORES = {"HOTA": "HOTA", "DetA": "DetA", "AssA": "AssA", "MOTA": "MOTA", "sAMOTA": "sAMOTA"}
EGO_TITLES = {
    "recording": "poses from the recording",
    "kiss_icp": "poses from KISS-ICP",
    "none": "no poses, tracks relative to the sensor",
}
COUNTS = {"labels": "labels", "IDSW": "switches", "false": "false"}


def print_tracking_report(content: dict, console: Console) -> None:
    """Print the scores (in percent) and counts of each class."""
    table = make_table(
        f"Tracking, {content['frames']} frames of {content['sequences']} sequences, {EGO_TITLES[content['ego']]}",
        "",
        *SCORES,
        *COUNTS,
        width=6,
    )
    for name, row in content["classes"].items():
        if row is not None:
            table.add_row(
                name, *(f"{100 * row[key]:.1f}" for key in SCORES.values()), *(str(row[key]) for key in COUNTS.values())
            )
    table.caption = "HOTA and MOTA by centres within 2 m, sAMOTA by 3D IoU 0.25. IDSW: id switches."
    console.print(table)
    if content["without_pose"]:
        console.print(
            Text("no pose", "yellow") + f": {content['without_pose']} of "
            f"{content['frames']} frames, in which tracks are extrapolated or relative to "
            "the sensor; check that the odometry or TF in the recording uses the same clock "
            "as the clouds, or use --ego kiss_icp"
        )
    print_skipped(content["skipped"], console)

"""Tables of pedestrian candidate scores by range and stage."""

from __future__ import annotations

from rich.console import Console

from lidar_perception.candidates.refine import STAGES
from lidar_perception.scoring.centres.matching import RANGE_NAMES
from lidar_perception.scoring.tables import format_counts, format_number, format_percent, make_table, print_skipped

STAGE_TITLES = {"stage1": "clusters", "stage2": "STM", "final": "STM + CPA"}
# Tables 3 and 6 of the STM-CPA paper: recall, precision, F1, and kept matches of stage 1 in percent, and centre
# error in metres.
PAPER_TABLE_6 = {
    "stage1": (55.5, 27.6, 36.8, None, 0.15),
    "stage2": (44.7, 60.5, 51.4, 80.6, 0.14),
    "final": (46.7, 58.8, 52.1, 83.7, 0.16),
}


def print_candidate_report(content: dict, console: Console) -> None:
    """Print the scores by range and stage, the paper's scores, and the durations of the steps."""
    table = make_table(
        f"{content['ground_truth']} pedestrians in {content['frames']} frames, hit = 3D centre within 1.0 m",
        "stage",
        "range [m]",
        "TP",
        "FP",
        "FN",
        "recall",
        "prec.",
        "F1",
        "error [m]",
        width=6,
    )
    for stage in [s for s in STAGES if s in content]:
        for name in (*RANGE_NAMES, "all"):
            row = content[stage][name]
            if row["tp"] + row["fp"] + row["fn"] == 0 and name != "all":
                continue
            table.add_row(
                STAGE_TITLES[stage] if name == "all" else "",
                name,
                *format_counts(row, "tp", "fp", "fn"),
                *format_percent(row, "recall", "precision", "f1"),
                format_number(row["centre_error_m"]),
                style="bold" if name == "all" else "",
            )
        recall, precision, f1, _, error = PAPER_TABLE_6[stage]
        table.add_row(
            "  the paper",
            "all",
            "",
            "",
            "",
            f"{recall}",
            f"{precision}",
            f"{f1}",
            f"{error:.2f}",
            style="dim",
            end_section=True,
        )
    console.print(table)
    if content["ms"]:
        times = make_table("Median duration per frame", "step", "ms", width=7)
        for step, ms in content["ms"].items():
            times.add_row(step, f"{ms:.2f}", style="bold" if step == "total" else "")
        console.print(times)
    print_skipped(content.get("skipped", []), console)

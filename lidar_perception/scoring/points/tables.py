"""Tables of ground and cluster scores."""

from __future__ import annotations

from rich.console import Console

from lidar_perception.scoring.points.segmentation import HIT_IOU, MIN_POINTS, PROTOCOLS
from lidar_perception.scoring.tables import format_counts, format_percent, make_table, print_skipped

# Precision, recall and F1 of Patchwork++ in percent, mean over sequences 00 to 10 of SemanticKITTI. The first
# row is from the paper (IROS 2022, Table I), the second from its repository.
PUBLISHED = {"without vegetation": (94.92, 98.18, 96.51), "with vegetation": (93.72, 92.33, 92.87)}


def print_scores(content: dict, ground_method: str, console: Console) -> None:
    """Print a table of ground scores, and a table of cluster scores for each recording format."""
    if content["ground"]:
        _print_ground(content["ground"], console)
    for source, reports in content["clusters"].items():
        _print_clusters(reports, f"Clusters of {source}, ground by {ground_method}", console)
    print_skipped(content["skipped"], console)


def _print_ground(reports: dict, console: Console) -> None:
    scans = max(report["scans"] for report in reports.values())
    table = make_table(
        f"Ground of SemanticKITTI, {_format_count(scans, 'scan')}",
        "vegetation is",
        "prec.",
        "recall",
        "F1",
        "acc.",
        "TP",
        "FP",
        "FN",
        "ms",
    )
    titles = dict(zip(PROTOCOLS, ("left out", "ground if below -1.3 m", "not ground")))
    for protocol in PROTOCOLS:
        table.add_row(titles[protocol], style="bold")
        for name, report in reports.items():
            row = report["protocols"][protocol]
            table.add_row(
                f"  {name}",
                *format_percent(row, "precision", "recall", "f1", "accuracy"),
                *format_counts(row, "tp", "fp", "fn"),
                _format_ms(report),
            )
        if protocol in PUBLISHED:
            table.add_row("  Patchwork++ published", *(f"{v:.1f}" for v in PUBLISHED[protocol]), style="dim")
    table.caption = (
        "Ground: road, parking, sidewalk, other-ground, lane-marking, terrain. ms: "
        "per scan. Published: mean of the sequences 00 to 10."
    )
    console.print(table)


def _print_clusters(reports: dict, title: str, console: Console) -> None:
    frames = max(report["frames"] for report in reports.values())
    table = make_table(
        f"{title}, {_format_count(frames, 'frame')}",
        "method",
        "objects",
        "hits",
        "recall",
        "prec.",
        "F1",
        "IoU",
        "over",
        "under",
        "found",
        "ms",
    )
    for name, report in reports.items():
        table.add_row(
            name, *_format_object(report), f"{report['clusters_per_frame']:.1f}", _format_ms(report), style="bold"
        )
        parts = {**report["by_class"], **{f"{r} m": row for r, row in report["by_range"].items()}}
        for part, row in parts.items():
            if row["objects"]:
                table.add_row(f"  {part}", *_format_object(row))
        table.add_section()
    table.caption = (
        f"Objects with {MIN_POINTS} points or more; hit: IoU above {HIT_IOU} with one "
        "cluster. over: split into pieces; under: merged with another one; found: "
        "clusters per frame; ms: per frame."
    )
    console.print(table)


def _format_object(row: dict) -> list[str]:
    """Format one row of objects. Only the row of all objects has precision and F1."""
    precision_cells = format_percent(row, "precision", "f1") if "precision" in row else ("", "")
    return [
        *format_counts(row, "objects", "hits"),
        *format_percent(row, "recall"),
        *precision_cells,
        *format_percent(row, "mean_iou", "over_segmentation", "under_segmentation"),
    ]


def _format_ms(report: dict) -> str:
    return f"{report['ms']:.{0 if report['ms'] >= 100 else 1}f}"


def _format_count(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"

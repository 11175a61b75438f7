"""Tables of the scores of a cluster network."""

from __future__ import annotations

from typing import Any

from rich.console import Console

from lidar_perception.scoring.tables import format_number, make_table, print_skipped

# Paper C: segmentation on KITTI, in percent.
PAPER = {"accuracy": 94.96, "precision": 94.3, "recall": 93.5, "f1": 93.9, "iou": 92.12}


def print_cluster_scores(content: dict[str, Any], console: Console) -> None:
    """Print the confusion matrix of clusters, the scores of points, and the paper's scores."""
    names = content["classes"]
    rows = content["clusters"]
    table = make_table(
        f"Clusters of {content['min_points']} points or more, {content['frames']} frames",
        "true \\ predicted",
        *names,
        "recall",
        "prec.",
    )
    for name, counts in zip(names, rows["confusion"]):
        row = rows["by_class"].get(name, {})
        table.add_row(name, *map(str, counts), _format_number(row.get("recall")), _format_number(row.get("precision")))
    table.caption = (
        f"{_format_number(rows['accuracy'])} % of the clusters, and "
        f"{_format_number(rows['object_accuracy'])} % of those of objects, are classified "
        "correctly."
    )
    console.print(table)
    table = make_table("Points in the image, in percent", "", "accuracy", "precision", "recall", "F1", "IoU")
    points = content["points"]
    table.add_row(
        "mean over classes",
        _format_number(points["accuracy"]),
        *(_format_number(points["mean"][key]) for key in ("precision", "recall", "f1", "iou")),
    )
    for name, row in points["by_class"].items():
        table.add_row(f"  {name}", "", *(_format_number(row[key]) for key in ("precision", "recall", "f1", "iou")))
    table.add_row("paper C, KITTI", *(_format_number(value) for value in PAPER.values()), style="dim")
    table.caption = "The paper does not define how points are counted."
    console.print(table)
    print_skipped(content["skipped"], console)


def _format_number(value: float | None) -> str:
    return format_number(value, digits=1)

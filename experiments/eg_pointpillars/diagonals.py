"""Diagonals of clusters and of labelled boxes by class (Table 2 and Figure 13 of the paper)."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.eg_pointpillars import paper
from experiments.framework.experiment import Cell, Figure, Line, Panel, Row, Section, Table
from experiments.framework.statistics import bootstrap, divide, make_cells, nan_to_none
from lidar_perception.clustering.shapes import classify_by_diagonal
from lidar_perception.types import CLASSES

NAMES = tuple(paper.TABLE_2)
BACKGROUND = "background"
BINS = np.arange(0.0, 8.01, 0.2)  # bin edges of Figure 13, in metres
PERCENTILES = (5, 50, 95)


def make_diagonal_section(records: list[dict[str, Any]]) -> Section:
    """Make Table 2 and Figure 13 from the records of measure_frame()."""
    tables = []
    for key, title in (("boxes", "Labelled boxes"), ("clusters", "Clusters of Patchwork++ and DBSCAN")):
        counts = np.array([count_classes(record[key]) for record in records], float).reshape(
            -1, len(NAMES) + 1, len(NAMES) + 1
        )
        percentages = bootstrap(counts, lambda sums: 100 * divide(sums, sums.sum(-1, keepdims=True)))
        values = np.array([pair for record in records for pair in record[key]]).reshape(-1, 2)
        rows: list[Row] = []
        for i, name in enumerate((*NAMES, BACKGROUND)):
            diagonals = values[_find_class_indices(values[:, 0]) == i, 1]
            if key == "boxes" and name == BACKGROUND:
                continue
            limits = paper.TABLE_2.get(name)
            percentiles = np.percentile(diagonals, PERCENTILES) if len(diagonals) else np.full(3, np.nan)
            rows.append(
                (
                    name,
                    str(len(diagonals)),
                    *(Cell(v, digits=2) for v in nan_to_none(percentiles)),
                    f"{limits[0]:.2f} to {limits[1]:.2f}" if limits else "none",
                    *make_cells(percentages[:, i]),
                )
            )
        header = (
            "class",
            "number",
            *(f"{p} % [m]" for p in PERCENTILES),
            "limits of Table 2 [m]",
            *(f"assigned to {name} [%]" for name in (*NAMES, "none")),
        )
        tables.append(Table(f"table_2_{key}", title, header, tuple(rows)))
    text = (
        "Table 2 classifies a cluster by the BEV diagonal of its box. The paper shows the "
        "diagonals of KITTI's labelled boxes (Figure 13); its limits for clusters were chosen "
        "by hand. Here a cluster has the class of the labelled box that contains most of its "
        "points; all other clusters are background."
    )
    return Section("Class by diagonal (Table 2, Figure 13)", text, tuple(tables), (_draw_histograms(records),))


def _find_class_indices(class_ids: np.ndarray) -> np.ndarray:
    """Return the index into NAMES of each class id (K,); len(NAMES) for other classes."""
    indices = np.full(len(class_ids), len(NAMES))
    for i, name in enumerate(NAMES):
        indices[class_ids == CLASSES.index(name)] = i
    return indices


def count_classes(pairs: list[list[float]]) -> list[list[int]]:
    """Count objects by true class and by the class of Table 2, (4, 4). The last row and column are for no class."""
    values = np.array(pairs, float).reshape(-1, 2)
    boxes = np.zeros((len(values), 7))
    boxes[:, 3] = values[:, 1]
    counts = np.zeros((len(NAMES) + 1, len(NAMES) + 1), int)
    np.add.at(counts, (_find_class_indices(values[:, 0]), _find_class_indices(classify_by_diagonal(boxes))), 1)
    return counts.tolist()


def _draw_histograms(records: list[dict[str, Any]]) -> Figure:
    panels = []
    middles = (BINS[:-1] + np.diff(BINS) / 2).tolist()
    for key, title in (("boxes", "labelled boxes"), ("clusters", "clusters")):
        values = np.array([pair for record in records for pair in record[key]]).reshape(-1, 2)
        class_indices = _find_class_indices(values[:, 0])
        counts = np.stack([np.histogram(values[class_indices == i, 1], BINS)[0] for i in range(len(NAMES))])
        histograms = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        lines = []
        for name, histogram in zip(NAMES, histograms):
            low = paper.TABLE_2[name][0]
            lines.append(Line(name, middles, histogram.tolist()))
            lines.append(Line(f"{name}, limit", (low, low), (0.0, float(histograms.max())), dashed=True))
        panels.append(Panel(title, "diagonal in x-y [m]", "fraction of the class", tuple(lines)))
    return Figure("figure_13", "Figure 13: diagonals by class, and the lower limits of Table 2", tuple(panels))

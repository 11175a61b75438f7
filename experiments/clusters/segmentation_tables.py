"""Tables and figures of the segmentation without networks (paper C, Tables 2 and 3, Figures 6 to 8)."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.clusters import paper
from experiments.clusters.segmentation import COUNT_COLUMNS, METHODS, STUDY, SWEEPS
from experiments.framework.experiment import Cell, Figure, Line, Panel, Row, Section, Table
from experiments.framework.statistics import (
    bootstrap,
    compute_paired_p,
    compute_rates,
    divide,
    make_cells,
    make_line,
    stack_counts,
)

SCORES = ("accuracy [%]", "precision [%]", "recall [%]", "F1 [%]", "IoU [%]")
IOU = 4  # index into SCORES
MEAN_IOU = 3  # index into the result of compute_object_scores()
REFERENCE = next(iter(METHODS))
PUBLISHED = {"ours": "ours", REFERENCE: "EC", "range image": "FCC"}  # our method -> similar method of the paper
DEFINITIONS = (
    "The paper does not say how points are counted. Here every labelled object is paired with at "
    "most one cluster, by the largest IoU of their points. A point on an object is right if it is in the cluster of "
    "that object; other points are right if they are outside all paired clusters. Ground outside objects is "
    "ignored. All methods cluster the same points, without the ground that the cloth method finds."
)


def make_segmentation_sections(records: list[dict[str, Any]], data: str) -> list[Section]:
    """Return Table 3 with Figures 6 to 8, and Table 2.

    Args:
        records: Records of measure_segmentation().
        data: Data set whose published values are shown, one of paper.DATA_SETS.
    """
    return [_make_methods_section(records, data), _make_sweeps_section(records, data)]


def compute_scores(sums: np.ndarray) -> np.ndarray:
    """Compute SCORES (..., 5) from sums of COUNT_COLUMNS (..., 9)."""
    points, correct, right_object, found_object, true_object, *_ = np.moveaxis(sums, -1, 0)
    return 100 * np.stack(
        [
            divide(correct, points),
            divide(right_object, found_object),
            divide(right_object, true_object),
            divide(2 * right_object, found_object + true_object),
            divide(right_object, found_object + true_object - right_object),
        ],
        axis=-1,
    )


def compute_object_scores(sums: np.ndarray) -> np.ndarray:
    """Compute recall, precision, F1 and mean IoU of objects (..., 4) in percent from sums of COUNT_COLUMNS."""
    objects, hits, clusters, iou = np.moveaxis(sums[..., 5:], -1, 0)
    rates = compute_rates(hits, clusters - hits, objects - hits)
    return np.concatenate([rates, 100 * divide(iou, objects)[..., None]], axis=-1)


def _make_methods_section(records: list[dict], data: str) -> Section:
    counts = {name: stack_counts([r["methods"][name] for r in records], len(COUNT_COLUMNS)) for name in METHODS}
    published_values = paper.SEGMENTATION[data]
    point_rows: list[Row] = []
    object_rows: list[Row] = []
    for name, method_counts in counts.items():
        values = published_values.get(PUBLISHED.get(name, ""), (None,) * 6)
        paired_counts = np.stack([method_counts, counts[REFERENCE]], axis=1)
        p = compute_paired_p(paired_counts, compute_object_scores)[MEAN_IOU]
        times = _bootstrap_times([[r["ms"][name], r["ms"]["ground"] + r["ms"][name]] for r in records], 2)
        gain_cells: Row = (
            ("", "")
            if name == REFERENCE
            else (*make_cells(bootstrap(paired_counts, _compute_gain)[:, None]), "–" if np.isnan(p) else f"{p:.3f}")
        )
        point_rows.append(
            (
                name,
                *make_cells(bootstrap(method_counts, compute_scores), values[:5]),
                *make_cells(times, (None, values[5])),
            )
        )
        object_rows.append(
            (
                name,
                *make_cells(bootstrap(method_counts, compute_object_scores)),
                *gain_cells,
                *(str(int(n)) for n in method_counts.sum(axis=0)[5:8]),
            )
        )
    point_rows += [
        (
            f"{name} (not implemented)",
            *(Cell(None, paper=value) for value in values[:5]),
            "",
            Cell(None, paper=values[5]),
        )
        for name, values in published_values.items()
        if name not in PUBLISHED.values()
    ]
    note = (
        "Times are means on this machine; the paper's times are from unknown hardware. The first "
        "time column is clustering only, the second ground and clustering. Range image: our "
        "substitute for FCC."
    )
    return Section(
        "Segmentation before any network (Table 3, Figures 6 and 8)",
        f"{len(records)} frames. {DEFINITIONS} Figures 6 and 7 of the paper plot accuracy and loss over "
        "iterations, which clustering does not have, so the values of the last iteration are shown.",
        (
            Table(
                "table_3",
                "Table 3 and Figures 6 and 8: by points",
                ("method", *SCORES, "clusters [ms]", "ground and clusters [ms]"),
                tuple(point_rows),
                note,
            ),
            Table(
                "table_3_objects",
                "By objects: a hit is an IoU of points above one half",
                (
                    "method",
                    "recall [%]",
                    "precision [%]",
                    "F1 [%]",
                    "mean IoU [%]",
                    f"above '{REFERENCE}' [points]",
                    "p",
                    "objects",
                    "hits",
                    "clusters near objects",
                ),
                tuple(object_rows),
                "p: paired permutation test of the mean IoU, over frames.",
            ),
        ),
    )


def _make_sweeps_section(records: list[dict], data: str) -> Section:
    rows: list[Row] = []
    panels = []
    published_values = paper.SEGMENTATION[data]["ours"]
    for name in SWEEPS:
        values = getattr(STUDY, name)
        estimates = []
        for value in values:
            key = f"{name} {value:g}"
            counts = stack_counts([r["sweeps"][key] for r in records], len(COUNT_COLUMNS))
            estimates.append(bootstrap(counts, compute_scores)[:, IOU])
            iou, ms = (published_values[4], published_values[5]) if value == paper.BEST[name] else (None, None)
            times = _bootstrap_times([[r["ms"]["ground"] + r["ms"][key]] for r in records], 1)
            rows.append((f"{name} = {value:g}", *make_cells(estimates[-1][:, None], [iou]), *make_cells(times, [ms])))
        lines = (
            make_line("measured", values, np.stack(estimates, axis=1)),
            Line("the paper's value", (paper.BEST[name],) * 2, (0.0, 100.0), dashed=True),
        )
        panels.append(Panel(name, name, "IoU [%]", lines))
    return Section(
        "Sensitivity (Table 2)",
        "One parameter is varied at a time; the others have the values of the "
        "paper (1.2, 0.5, 0.8). The text of the paper gives results only for the best values.",
        (
            Table(
                "table_2",
                "Table 2: alpha, beta and gamma",
                ("value", "IoU [%]", "ground and clusters [ms]"),
                tuple(rows),
            ),
        ),
        (Figure("table_2", "Table 2: IoU over alpha, beta and gamma", tuple(panels)),),
    )


def _compute_gain(sums: np.ndarray) -> np.ndarray:
    """Compute the mean IoU of the first method minus that of the second (...,) from sums (..., 2, 9)."""
    iou = compute_object_scores(sums)[..., MEAN_IOU]
    return iou[..., 0] - iou[..., 1]


def _bootstrap_times(times: list[list[float]], columns: int) -> np.ndarray:
    """Compute the means of times (F, columns), with their intervals: (3, columns)."""
    counts = stack_counts([[1.0, *row] for row in times], 1 + columns)
    return bootstrap(counts, lambda sums: divide(sums[..., 1:], sums[..., :1]))

"""Tables and figures of the segmentation before any network (paper C, Table 2 and 3, Figs 6-8)."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.clusters import paper
from experiments.clusters.segmentation import COUNTS, METHODS, STUDY, SWEEPS
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
# Our methods, and the paper's names for the same kinds of method.
PUBLISHED = {"ours": "ours", REFERENCE: "EC", "range image": "FCC"}
DEFINITIONS = (
    "The paper does not say how points are counted. Here every labelled object is paired with at "
    "most one cluster, by the largest IoU of their points. A point is right in the cluster of its "
    "own object, or outside all paired clusters if it is of no object. Ground outside objects does "
    "not count. All methods cluster the points that the cloth does not call ground."
)


def make_segmentation_sections(records: list[dict[str, Any]], data: str) -> list[Section]:
    """Return Table 3 with Figures 6 to 8, and Table 2.

    Args:
        records: Of measure_segmentation().
        data: One of paper.DATA_SETS, whose values are shown.
    """
    return [_make_methods_section(records, data), _make_sweeps_section(records, data)]


def compute_scores(sums: np.ndarray) -> np.ndarray:
    """Return SCORES (..., 5) of sums of COUNTS (..., 9)."""
    points, right, both, found, true, *_ = np.moveaxis(sums, -1, 0)
    return 100 * np.stack(
        [
            divide(right, points),
            divide(both, found),
            divide(both, true),
            divide(2 * both, found + true),
            divide(both, found + true - both),
        ],
        axis=-1,
    )


def compute_object_scores(sums: np.ndarray) -> np.ndarray:
    """Return recall, precision, F1 and mean IoU (..., 4) in percent, by objects, of sums of
    COUNTS."""
    objects, hits, judged, iou = np.moveaxis(sums[..., 5:], -1, 0)
    rates = compute_rates(hits, judged - hits, objects - hits)
    return np.concatenate([rates, 100 * divide(iou, objects)[..., None]], axis=-1)


def _make_methods_section(records: list[dict], data: str) -> Section:
    counts = {name: stack_counts([r["methods"][name] for r in records], len(COUNTS)) for name in METHODS}
    published = paper.SEGMENTATION[data]
    rows: list[Row] = []
    hits: list[Row] = []
    for name, own in counts.items():
        values = published.get(PUBLISHED.get(name, ""), (None,) * 6)
        both = np.stack([own, counts[REFERENCE]], axis=1)
        p = compute_paired_p(both, compute_object_scores)[MEAN_IOU]
        times = _bootstrap_times([[r["ms"][name], r["ms"]["ground"] + r["ms"][name]] for r in records], 2)
        against: Row = (
            ("", "")
            if name == REFERENCE
            else (*make_cells(bootstrap(both, _compute_gain)[:, None]), "–" if np.isnan(p) else f"{p:.3f}")
        )
        rows.append(
            (name, *make_cells(bootstrap(own, compute_scores), values[:5]), *make_cells(times, (None, values[5])))
        )
        hits.append(
            (
                name,
                *make_cells(bootstrap(own, compute_object_scores)),
                *against,
                *(str(int(n)) for n in own.sum(axis=0)[5:8]),
            )
        )
    rows += [
        (
            f"{name} (not implemented)",
            *(Cell(None, paper=value) for value in values[:5]),
            "",
            Cell(None, paper=values[5]),
        )
        for name, values in published.items()
        if name not in PUBLISHED.values()
    ]
    note = (
        "Times are means on this machine, those of the paper on unknown hardware: in the first "
        "column clustering alone, in the second ground and clustering. Range image: our "
        "stand-in for FCC."
    )
    return Section(
        "Segmentation before any network (Table 3, Figures 6 and 8)",
        f"{len(records)} frames. {DEFINITIONS} Figure 6 and 7 plot accuracy and loss over "
        "iterations, which clustering does not have; the values of the last iteration are shown.",
        (
            Table(
                "table_3",
                "Table 3 and Figures 6 and 8: by points",
                ("method", *SCORES, "clusters [ms]", "ground and clusters [ms]"),
                tuple(rows),
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
                tuple(hits),
                "p: paired permutation test of the mean IoU, over frames.",
            ),
        ),
    )


def _make_sweeps_section(records: list[dict], data: str) -> Section:
    rows: list[Row] = []
    panels = []
    best = paper.SEGMENTATION[data]["ours"]
    for name in SWEEPS:
        values = getattr(STUDY, name)
        estimates = []
        for value in values:
            key = f"{name} {value:g}"
            own = stack_counts([r["sweeps"][key] for r in records], len(COUNTS))
            estimates.append(bootstrap(own, compute_scores)[:, IOU])
            known = (best[4], best[5]) if value == paper.BEST[name] else (None, None)
            times = _bootstrap_times([[r["ms"]["ground"] + r["ms"][key]] for r in records], 1)
            rows.append(
                (f"{name} = {value:g}", *make_cells(estimates[-1][:, None], known[:1]), *make_cells(times, known[1:]))
            )
        lines = (
            make_line("measured", values, np.stack(estimates, axis=1)),
            Line("the paper's value", (paper.BEST[name],) * 2, (0.0, 100.0), dashed=True),
        )
        panels.append(Panel(name, name, "IoU [%]", lines))
    return Section(
        "Sensitivity (Table 2)",
        "One value is changed at a time; the others are those of the "
        "paper (1.2, 0.5, 0.8). The text of the paper gives the figures of the best values only.",
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
    """Return the mean IoU of the first less that of the second (...,) of sums (..., 2, 9)."""
    iou = compute_object_scores(sums)[..., MEAN_IOU]
    return iou[..., 0] - iou[..., 1]


def _bootstrap_times(times: list[list[float]], columns: int) -> np.ndarray:
    """Return the means (3, columns) of times (F, columns), with their intervals."""
    counts = stack_counts([[1.0, *row] for row in times], 1 + columns)
    return bootstrap(counts, lambda sums: divide(sums[..., 1:], sums[..., :1]))

"""Tables and figures of the parameter search for DBSCAN (Figure 7 of the paper)."""

from __future__ import annotations

import numpy as np

from experiments.framework.experiment import Cell, Figure, Line, Panel, Section, Table
from experiments.framework.statistics import bootstrap, compute_rates, make_cells, make_line, nan_to_none, stack_counts
from experiments.stm_cpa import paper
from experiments.stm_cpa.params import StmCpaParams
from lidar_perception.scoring.centres.matching import RANGE_NAMES

NUMBERS = StmCpaParams()
RATES = ("recall [%]", "precision [%]", "F1 [%]")
COUNTS = ("hits", "false", "misses")


def make_search_section(records: list[dict]) -> Section:
    """Make the section about the search from the records of measure_frame()."""
    eps, min_samples = NUMBERS.search_eps, NUMBERS.search_min_samples
    positives = stack_counts([r["search"] for r in records], len(eps) * len(min_samples), 2, len(RANGE_NAMES))
    label_counts = stack_counts([r["pedestrians"] for r in records], 1, len(RANGE_NAMES))
    counts = np.stack([positives[:, :, 0], positives[:, :, 1], label_counts - positives[:, :, 0]], axis=1)
    estimates = bootstrap(counts, lambda sums: compute_rates(*np.moveaxis(sums, -3, 0)))
    sums = counts.sum(axis=0).astype(int)
    settings = [(e, n) for e in eps for n in min_samples]

    def make_row(setting: int, group: int) -> tuple[str | Cell, ...]:
        e, n = settings[setting]
        return (f"{e:.2f}", str(n), *make_cells(estimates[:, setting, group]), *map(str, sums[:, setting, group]))

    best_rows, all_rows = [], []
    for group, name in enumerate(RANGE_NAMES):
        if label_counts[:, 0, group].sum() == 0:
            continue
        all_rows += [(name, *make_row(k, group)) for k in range(len(settings))]
        paper_setting = settings.index((_find_paper_eps(name), paper.MIN_SAMPLES))
        best_rows.append((name, "the paper's", *make_row(paper_setting, group)))
        recall, _, f1 = np.nan_to_num(estimates[0, :, group]).T
        if recall.any():
            best_rows += [
                (name, title, *make_row(int(score.argmax()), group))
                for title, score in (("best recall", recall + 1e-6 * f1), ("best F1", f1))
            ]
    header = ("eps [m]", "min_samples", *RATES, *COUNTS)
    text = (
        f"Only clusters of the seed's height are used; hits are within {NUMBERS.search_distance:g} m. The paper "
        "describes its Figure 7 in words: recall is high at eps 0.15 to 0.20 m below 15 m, 0.25 "
        "to 0.35 m from 15 to 30 m, and 0.40 to 0.50 m beyond; a larger min_samples lowers "
        "recall."
    )
    return Section(
        "DBSCAN parameters (Figure 7)",
        text,
        (
            Table(
                "search_best",
                "The paper's setting and the best of the search",
                ("range [m]", "setting", *header),
                tuple(best_rows),
                "The intervals do not account for the choice of the best among many settings.",
            ),
            Table("search", "All settings", ("range [m]", *header), tuple(all_rows)),
        ),
        (_draw_figure_7(estimates), _draw_min_samples(estimates)),
    )


def _find_paper_eps(name: str) -> float:
    return paper.FIGURE_7.get(name, paper.FIGURE_7["30-45"])[1]


def _draw_figure_7(estimates: np.ndarray) -> Figure:
    eps, min_samples = NUMBERS.search_eps, NUMBERS.search_min_samples
    rows = [k * len(min_samples) + min_samples.index(paper.MIN_SAMPLES) for k in range(len(eps))]
    return Figure(
        "figure_7",
        f"Figure 7: eps, with min_samples {paper.MIN_SAMPLES}",
        tuple(
            Panel(
                f"{name} m",
                "eps [m]",
                "%",
                (
                    *(
                        make_line(label.removesuffix(" [%]"), eps, estimates[:, rows, RANGE_NAMES.index(name), k])
                        for k, label in enumerate(RATES)
                    ),
                    Line("the paper's eps", (paper_eps, paper_eps), (0.0, 100.0), dashed=True),
                ),
            )
            for name, (_, paper_eps) in paper.FIGURE_7.items()
        ),
    )


def _draw_min_samples(estimates: np.ndarray) -> Figure:
    eps, min_samples = NUMBERS.search_eps, NUMBERS.search_min_samples
    recall = estimates[0, ..., 0]
    return Figure(
        "figure_7_min_samples",
        "Recall by eps and min_samples",
        tuple(
            Panel(
                f"{name} m",
                "eps [m]",
                "recall [%]",
                tuple(
                    Line(f"min_samples {n}", eps, nan_to_none(recall[k :: len(min_samples), RANGE_NAMES.index(name)]))
                    for k, n in enumerate(min_samples)
                ),
            )
            for name in paper.FIGURE_7
        ),
    )

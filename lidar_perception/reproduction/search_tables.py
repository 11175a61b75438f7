"""The search for DBSCAN's parameters: what Figure 7 of paper A shows, in numbers."""

from __future__ import annotations

import numpy as np

from lidar_perception.reproduction.experiment import Cell, Figure, Line, Panel, Section, Table
from lidar_perception.reproduction.params import StmCpaParams
from lidar_perception.reproduction.statistics import bootstrap, cells, curve, known, rates, stack
from lidar_perception.scoring.centres import paper
from lidar_perception.scoring.centres.matching import RANGE_NAMES

NUMBERS = StmCpaParams()
RATES = ("recall [%]", "precision [%]", "F1 [%]")
COUNTS = ("hits", "false", "misses")


def search_section(records: list[dict]) -> Section:
    """Tables and figures of the search in records of stm_cpa.py."""
    eps, least = NUMBERS.search_eps, NUMBERS.search_min_samples
    found = stack([r["search"] for r in records], len(eps) * len(least), 2, len(RANGE_NAMES))
    truth = stack([r["pedestrians"] for r in records], 1, len(RANGE_NAMES))
    counts = np.stack([found[:, :, 0], found[:, :, 1], truth - found[:, :, 0]], axis=1)
    estimates = bootstrap(counts, lambda sums: rates(*np.moveaxis(sums, -3, 0)))
    sums = counts.sum(axis=0).astype(int)
    settings = [(e, n) for e in eps for n in least]

    def row(setting: int, there: int) -> tuple[str | Cell, ...]:
        e, n = settings[setting]
        return (f"{e:.2f}", str(n), *cells(estimates[:, setting, there]),
                *map(str, sums[:, setting, there]))

    best, every = [], []
    for there, name in enumerate(RANGE_NAMES):
        if truth[:, 0, there].sum() == 0:
            continue
        every += [(name, *row(k, there)) for k in range(len(settings))]
        chosen = settings.index((_chosen(name), paper.MIN_SAMPLES))
        best.append((name, "the paper's", *row(chosen, there)))
        recall, _, f1 = np.nan_to_num(estimates[0, :, there]).T
        if recall.any():
            best += [(name, what, *row(int(score.argmax()), there)) for what, score in
                     (("most recall", recall + 1e-6 * f1), ("most F1", f1))]
    header = ("eps [m]", "min_samples", *RATES, *COUNTS)
    text = (f"Clusters of the seed's height, hit within {NUMBERS.search_distance:g} m. The paper "
            "describes its Figure 7 in words: much recall at eps 0.15 to 0.20 m near, 0.25 to "
            "0.35 m from 15 to 30 m, 0.40 to 0.50 m beyond; less recall with every larger "
            "min_samples.")
    return Section(
        "DBSCAN parameters (Figure 7)", text,
        (Table("search_best", "The paper's setting and the best of the search",
               ("range [m]", "setting", *header), tuple(best),
               "Intervals do not count that the best was picked from many."),
         Table("search", "All settings", ("range [m]", *header), tuple(every))),
        (_figure_7(estimates), _figure_min_samples(estimates)))


def _chosen(name: str) -> float:
    """The paper's eps for a range."""
    return paper.FIGURE_7.get(name, paper.FIGURE_7["30-45"])[1]


def _figure_7(estimates: np.ndarray) -> Figure:
    eps, least = NUMBERS.search_eps, NUMBERS.search_min_samples
    at = [k * len(least) + least.index(paper.MIN_SAMPLES) for k in range(len(eps))]
    return Figure("figure_7", f"Figure 7: eps, with min_samples {paper.MIN_SAMPLES}", tuple(
        Panel(f"{name} m", "eps [m]", "%", (
            *(curve(label.removesuffix(" [%]"), eps, estimates[:, at, RANGE_NAMES.index(name), k])
              for k, label in enumerate(RATES)),
            Line("the paper's eps", (chosen, chosen), (0.0, 100.0), dashed=True)))
        for name, (_, chosen) in paper.FIGURE_7.items()))


def _figure_min_samples(estimates: np.ndarray) -> Figure:
    eps, least, recall = NUMBERS.search_eps, NUMBERS.search_min_samples, estimates[0, ..., 0]
    return Figure("figure_7_min_samples", "Recall by eps and min_samples", tuple(
        Panel(f"{name} m", "eps [m]", "recall [%]", tuple(
            Line(f"min_samples {n}", eps, known(recall[k::len(least), RANGE_NAMES.index(name)]))
            for k, n in enumerate(least))) for name in paper.FIGURE_7))

"""The tables and figures of paper A from the records of stm_cpa.py, beside the paper's figures."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar_perception.candidates.refine import STAGES
from lidar_perception.reproduction.experiment import Cell, Figure, Line, Panel, Row, Section, Table
from lidar_perception.reproduction.params import StmCpaParams
from lidar_perception.reproduction.search_tables import COUNTS, RATES, search_section
from lidar_perception.reproduction.statistics import (
    bootstrap,
    cells,
    curve,
    known,
    rates,
    ratio,
    stack,
)
from lidar_perception.scoring.centres import paper
from lidar_perception.scoring.centres.matching import MAX_CENTRE_DISTANCE, RANGE_NAMES

NUMBERS = StmCpaParams()
STAGE_TITLES = {"stage1": "1 height filter", "stage2": "2 STM", "final": "3 STM + CPA"}
SCORES = (*RATES, "kept of stage 1 [%]", "centre error [m]")
DIGITS = (1, 1, 1, 1, 2)
STEPS = ("preprocessing", "DBSCAN", "ground snapping", "height filter", "STM", "CPA", "total")


def sections(records: list[dict[str, Any]]) -> list[Section]:
    """The report of these records; those that were skipped are left out."""
    records = [record for record in records if "skipped" not in record]
    parts = (_truth, search_section, _stages, _cpa, _overlap, _runtime)
    return [part(records) for part in parts]


def _truth(records: list[dict]) -> Section:
    counts = stack([r["pedestrians"] for r in records], len(RANGE_NAMES))
    shares = bootstrap(counts, lambda sums: 100 * ratio(sums, sums.sum(axis=-1, keepdims=True)))
    published = list(paper.TABLE_1.values())
    rows: list[Row] = [
        (name, Cell(float(count), paper=there, digits=0), share) for name, count, there, share
        in zip(RANGE_NAMES, counts.sum(axis=0), published,
               cells(shares, [100 * n / paper.PEDESTRIANS for n in published]))]
    rows.append(("all", Cell(float(counts.sum()), paper=paper.PEDESTRIANS, digits=0), ""))
    without = [r for r in records if r["no_seed"]]
    frames = Table(
        "frames", "Frames", ("", "count"),
        (("frames with a Pedestrian label", Cell(len(records), paper=paper.FRAMES, digits=0)),
         ("of them without a seed", Cell(len(without), digits=0)),
         ("pedestrians in these, all misses",
          Cell(sum(sum(r["pedestrians"]) for r in without), digits=0))))
    no_seed = Table("no_seed", "Frames without a seed", ("frame", "pedestrians", "reason"),
                    tuple((r["frame"], str(sum(r["pedestrians"])), r["no_seed"]) for r in without))
    table = Table("table_1", "Table 1: ground truth by range",
                  ("range [m]", "pedestrians", "share [%]"), tuple(rows))
    return Section("Ground truth (Table 1)", "", (table, frames, *([no_seed] if without else ())))


def _stages(records: list[dict]) -> Section:
    overall: list[Row] = []
    by_range: list[Row] = []
    for stage in STAGES:
        counts = _counts(records, [r["stages"][stage] for r in records])
        estimates, sums = bootstrap(counts, _scores), counts.sum(axis=0)
        overall.append((STAGE_TITLES[stage], *_score_cells(estimates[:, -1], paper.TABLE_6[stage]),
                        *_numbers(sums.sum(axis=-1))))
        by_range += [(name, STAGE_TITLES[stage], str(int(sums[0, k] + sums[2, k])),
                      *_score_cells(estimates[:, k], paper.TABLE_4[name].get(stage, ())),
                      *_numbers(sums[:, k])) for k, name in enumerate(RANGE_NAMES)]
    by_range.sort(key=lambda row: RANGE_NAMES.index(row[0]))  # stable: the stages stay in order
    note = ("Kept: of the pedestrians that stage 1 hits, the share that is still hit. A hit: 3D "
            f"centres within {MAX_CENTRE_DISTANCE:g} m, one to one.")
    return Section(
        "Stages (Tables 3, 4 and 6)", "",
        (Table("table_3_6", "Tables 3 and 6: all ranges", ("stage", *SCORES, *COUNTS),
               tuple(overall), note),
         Table("table_4", "Table 4: by range", ("range [m]", "stage", "pedestrians", *SCORES,
                                                *COUNTS), tuple(by_range), note)))


def _cpa(records: list[dict]) -> Section:
    steps = range(NUMBERS.cpa_steps + 1)
    rows: list[Row] = []
    estimates = []
    for k in steps:
        counts = _counts(records, [r["cpa"][k] for r in records])
        estimates.append(bootstrap(counts, _scores))
        published = paper.TABLE_5[k] if k < len(paper.TABLE_5) else ()
        rows.append((str(k), *_score_cells(estimates[-1][:, -1], published),
                     *_numbers(counts.sum(axis=(0, 2)))))
    drawn = np.stack(estimates, axis=1)  # (3, steps, groups, scores)
    ranges = f"{NUMBERS.cpa_min_range:g} to {NUMBERS.cpa_max_range:g} m"
    panels = []
    for m, label in enumerate(RATES):
        lines = [curve(f"{name} m", steps, drawn[:, :, RANGE_NAMES.index(name), m])
                 for name in paper.FIGURE_8]
        for name, points in paper.FIGURE_8.items():
            there = {k: values[m] for k, values in points.items() if values[m] is not None}
            lines.append(Line(f"{name} m, paper", tuple(there), tuple(there.values()), dashed=True))
        panels.append(Panel(label.removesuffix(" [%]"), "CPA steps", "%", tuple(lines)))
    by_range: list[Row] = [
        (name, str(k), *_score_cells(drawn[:, k, RANGE_NAMES.index(name)], ()))
        for name in paper.FIGURE_8 for k in steps]
    return Section(
        "CPA steps (Table 5, Figure 8)", f"Copies are added to clusters at {ranges}. The scores of "
        "Table 5 are those of all ranges. Of Figure 8 the paper gives numbers for no steps, and "
        "the F1 of two steps at 15 to 30 m.",
        (Table("table_5", f"Table 5: CPA at {ranges}", ("steps", *SCORES, *COUNTS), tuple(rows)),
         Table("figure_8", "Figure 8 in numbers", ("range [m]", "steps", *SCORES),
               tuple(by_range))),
        (Figure("figure_8", "Figure 8: CPA steps by range", tuple(panels)),))


def _overlap(records: list[dict]) -> Section:
    limits = len(NUMBERS.iou_limits)
    header = ["stage", *(f"{kind} IoU >= {limit:.2f} [%]" for kind in ("3D", "BEV")
                         for limit in NUMBERS.iou_limits), "mean 3D IoU", "mean BEV IoU", "hits"]
    scale = np.array([100.0] * 2 * limits + [1.0] * 2)
    rows: list[Row] = []
    for stage in STAGES:
        counts = stack([r["overlap"][stage] for r in records], 3 + 2 * limits)
        estimates = bootstrap(counts, lambda sums: scale * ratio(sums[..., 1:], sums[..., :1]))
        rows.append((STAGE_TITLES[stage], *cells(estimates, paper.TABLE_8[stage],
                                                 [1] * 2 * limits + [3, 3]),
                     str(int(counts[:, 0].sum()))))
    return Section("Overlap (Table 8)", "IoU of the hits with the labelled boxes, which are "
                   "turned; those found are not.",
                   (Table("table_8", "Table 8: IoU of the hits", tuple(header), tuple(rows)),))


def _runtime(records: list[dict]) -> Section:
    timed = [r for r in records if r["ms"]]
    means: list[Row] = []
    medians: list[Row] = []
    for name, published in paper.TABLE_9.items():
        ms = stack([_steps(r["ms"], name) for r in timed], len(STEPS))
        estimates = bootstrap(np.column_stack([np.ones(len(ms)), ms]),
                              lambda sums: ratio(sums[..., 1:], sums[..., :1]))
        means.append((name, *cells(estimates, published, 2)))
        middle = np.median(ms, axis=0) if len(ms) else np.full(len(STEPS), np.nan)
        medians.append((name, *(Cell(value, digits=2) for value in known(middle))))
    clusters = stack([r["clusters"] for r in timed], 2).sum(axis=0) / max(len(timed), 1)
    note = ("Preprocessing is the crop to the camera; ground snapping has the RANSAC plane in it. "
            "Reading the files is left out. The paper gives means, of unknown hardware. Processes "
            "that run side by side slow each other down: use --jobs 1 for clean times. STM "
            f"compares {clusters[0]:.1f} clusters a frame without the height filter, "
            f"{clusters[1]:.1f} with it.")
    header = ("setting", *(f"{step} [ms]" for step in STEPS))
    return Section("Runtime (Table 9)", "", (
        Table("table_9", "Table 9: mean time a frame", header, tuple(means), note),
        Table("table_9_median", "Median time a frame", header, tuple(medians))))


def _steps(ms: dict[str, float], configuration: str) -> list[float]:
    """Times of the STEPS in a configuration of Table 9."""
    height, stm, cpa = {"no height filter": (0.0, ms["stm_all"], 0.0),
                        "height filter": (ms["height"], ms["stm"], 0.0),
                        "final": (ms["height"], ms["stm"], ms["cpa"])}[configuration]
    steps = [ms["view"], ms["clustering"], ms["ground"] + ms["boxes"], height, stm, cpa]
    return [*steps, sum(steps)]


def _counts(records: list[dict], of_stage: list[dict]) -> np.ndarray:
    """(F, 6, 5) hits, false positives, misses, kept, centre error, hits of stage 1, by range."""
    fields = ("tp", "fp", "fn", "kept", "error")
    return stack([[*(counts[k] for k in fields), record["stages"]["stage1"]["tp"]]
                   for record, counts in zip(records, of_stage)], 6, len(RANGE_NAMES))


def _scores(sums: np.ndarray) -> np.ndarray:
    """(..., 6, 5) SCORES of each range and of all, of sums of _counts() (..., 6, 5)."""
    sums = np.concatenate([sums, sums.sum(axis=-1, keepdims=True)], axis=-1)
    tp, fp, fn, kept, error, before = np.moveaxis(sums, -2, 0)
    others = np.stack([100 * ratio(kept, before), ratio(error, tp)], axis=-1)
    return np.concatenate([rates(tp, fp, fn), others], axis=-1)


def _score_cells(estimates: np.ndarray, published: tuple) -> tuple[Cell, ...]:
    return cells(estimates, published, DIGITS)


def _numbers(sums: np.ndarray) -> tuple[str, ...]:
    """COUNTS of sums of _counts() over frames and ranges (6,)."""
    return tuple(str(int(value)) for value in sums[:len(COUNTS)])

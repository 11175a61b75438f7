"""Tables and figures of the STM-CPA experiment, next to the paper's values."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.framework.experiment import Cell, Figure, Line, Panel, Row, Section, Table
from experiments.framework.statistics import (
    bootstrap,
    compute_rates,
    divide,
    make_cells,
    make_line,
    nan_to_none,
    stack_counts,
)
from experiments.stm_cpa import paper
from experiments.stm_cpa.params import READINGS, StmCpaParams
from experiments.stm_cpa.search_tables import COUNTS, RATES, make_search_section
from lidar_perception.candidates.refine import STAGES
from lidar_perception.scoring.centres.matching import MAX_CENTRE_DISTANCE, RANGE_NAMES
from lidar_perception.scoring.centres.tables import PAPER_TABLE_6

NUMBERS = StmCpaParams()
STAGE_TITLES = {"stage1": "1 height filter", "stage2": "2 STM", "final": "3 STM + CPA"}
SCORES = (*RATES, "kept of stage 1 [%]", "centre error [m]")
DIGITS = (1, 1, 1, 1, 2)
STEPS = ("preprocessing", "DBSCAN", "ground snapping", "height filter", "STM", "CPA", "total")


def make_sections(records: list[dict[str, Any]]) -> list[Section]:
    """Make the report from the records of measure_frame(), without skipped frames."""
    records = [record for record in records if "skipped" not in record]
    functions = (
        _make_truth_section,
        make_search_section,
        _make_stages_section,
        _make_cpa_section,
        _make_readings_section,
        _make_detectors_section,
        _make_overlap_section,
        _make_runtime_section,
    )
    return [make_section(records) for make_section in functions]


def _make_truth_section(records: list[dict]) -> Section:
    counts = stack_counts([r["pedestrians"] for r in records], len(RANGE_NAMES))
    percentages = bootstrap(counts, lambda sums: 100 * divide(sums, sums.sum(axis=-1, keepdims=True)))
    published_values = list(paper.TABLE_1.values())
    rows: list[Row] = [
        (name, Cell(float(count), paper=paper_count, digits=0), percentage)
        for name, count, paper_count, percentage in zip(
            RANGE_NAMES,
            counts.sum(axis=0),
            published_values,
            make_cells(percentages, [100 * n / paper.PEDESTRIANS for n in published_values]),
        )
    ]
    rows.append(("all", Cell(float(counts.sum()), paper=paper.PEDESTRIANS, digits=0), ""))
    seedless_records = [r for r in records if r["no_seed"]]
    frames = Table(
        "frames",
        "Frames",
        ("", "count"),
        (
            ("frames with a Pedestrian label", Cell(len(records), paper=paper.FRAMES, digits=0)),
            ("without a seed", Cell(len(seedless_records), digits=0)),
            (
                "pedestrians in frames without a seed (misses)",
                Cell(sum(sum(r["pedestrians"]) for r in seedless_records), digits=0),
            ),
        ),
    )
    no_seed = Table(
        "no_seed",
        "Frames without a seed",
        ("frame", "pedestrians", "reason"),
        tuple((r["frame"], str(sum(r["pedestrians"])), r["no_seed"]) for r in seedless_records),
    )
    table = Table("table_1", "Table 1: ground truth by range", ("range [m]", "pedestrians", "share [%]"), tuple(rows))
    return Section("Ground truth (Table 1)", "", (table, frames, *([no_seed] if seedless_records else ())))


def _make_stages_section(records: list[dict]) -> Section:
    total_rows: list[Row] = []
    range_rows: list[Row] = []
    for stage in STAGES:
        counts = _stack_scores(records, [r["stages"][stage] for r in records])
        estimates, sums = bootstrap(counts, _compute_scores), counts.sum(axis=0)
        total_rows.append(
            (
                STAGE_TITLES[stage],
                *_make_score_cells(estimates[:, -1], PAPER_TABLE_6[stage]),
                *_format_counts(sums.sum(axis=-1)),
            )
        )
        range_rows += [
            (
                name,
                STAGE_TITLES[stage],
                str(int(sums[0, k] + sums[2, k])),
                *_make_score_cells(estimates[:, k], paper.TABLE_4[name].get(stage, ())),
                *_format_counts(sums[:, k]),
            )
            for k, name in enumerate(RANGE_NAMES)
        ]
    range_rows.sort(key=lambda row: RANGE_NAMES.index(row[0]))  # the sort is stable, so the stages stay in order
    note = (
        "Kept: fraction of the hits of stage 1 that are still hits. A hit has its 3D "
        f"centre within {MAX_CENTRE_DISTANCE:g} m of the label, one to one."
    )
    return Section(
        "Stages (Tables 3, 4 and 6)",
        "",
        (
            Table("table_3_6", "Tables 3 and 6: all ranges", ("stage", *SCORES, *COUNTS), tuple(total_rows), note),
            Table(
                "table_4",
                "Table 4: by range",
                ("range [m]", "stage", "pedestrians", *SCORES, *COUNTS),
                tuple(range_rows),
                note,
            ),
        ),
    )


def _make_cpa_section(records: list[dict]) -> Section:
    steps = range(NUMBERS.cpa_steps + 1)
    rows: list[Row] = []
    estimates = []
    for k in steps:
        counts = _stack_scores(records, [r["cpa"][k] for r in records])
        estimates.append(bootstrap(counts, _compute_scores))
        published_values = paper.TABLE_5[k] if k < len(paper.TABLE_5) else ()
        rows.append(
            (
                str(k),
                *_make_score_cells(estimates[-1][:, -1], published_values),
                *_format_counts(counts.sum(axis=(0, 2))),
            )
        )
    stacked_estimates = np.stack(estimates, axis=1)  # (3, steps, ranges, scores)
    ranges = f"{NUMBERS.cpa_min_range:g} to {NUMBERS.cpa_max_range:g} m"
    panels = []
    for m, label in enumerate(RATES):
        lines = [
            make_line(f"{name} m", steps, stacked_estimates[:, :, RANGE_NAMES.index(name), m])
            for name in paper.FIGURE_8
        ]
        for name, values_by_steps in paper.FIGURE_8.items():
            points = {k: values[m] for k, values in values_by_steps.items() if values[m] is not None}
            lines.append(Line(f"{name} m, paper", tuple(points), tuple(points.values()), dashed=True))
        panels.append(Panel(label.removesuffix(" [%]"), "CPA steps", "%", tuple(lines)))
    range_rows: list[Row] = [
        (name, str(k), *_make_score_cells(stacked_estimates[:, k, RANGE_NAMES.index(name)], ()))
        for name in paper.FIGURE_8
        for k in steps
    ]
    return Section(
        "CPA steps (Table 5, Figure 8)",
        f"CPA adds copies to clusters at {ranges}. The scores in "
        "Table 5 are over all ranges. For Figure 8 the paper gives only the values without CPA, and the F1 "
        "for two steps at 15 to 30 m.",
        (
            Table("table_5", f"Table 5: CPA at {ranges}", ("steps", *SCORES, *COUNTS), tuple(rows)),
            Table("figure_8", "Figure 8 in numbers", ("range [m]", "steps", *SCORES), tuple(range_rows)),
        ),
        (Figure("figure_8", "Figure 8: CPA steps by range", tuple(panels)),),
    )


def _make_readings_section(records: list[dict]) -> Section:
    rows = tuple(
        _make_score_row(name, records, [r["readings"][name] for r in records], PAPER_TABLE_6["final"])
        for name in READINGS
    )
    return Section(
        "Readings of the silhouettes (Table 2, Section 3.5)",
        "The text does not say whether each cluster is stretched to the window of 80 x 32 or the window has a size in "
        "metres, nor whether PCA may tilt a cluster. All other tables use the first row.",
        (Table("readings", "Last stage by reading", ("reading", *SCORES, *COUNTS), rows),),
    )


def _make_detectors_section(records: list[dict]) -> Section:
    rows = [
        _make_score_row(STAGE_TITLES[stage], records, [r["stages"][stage] for r in records], PAPER_TABLE_6[stage])
        for stage in STAGES
    ]
    rows.append(
        _make_score_row(
            "PointPillars V0, ours", records, [r["pointpillars"] for r in records], paper.TABLE_7["PointPillars"]
        )
    )
    rows += [
        (f"{name} (not run)", *(Cell(None, paper=value, digits=d) for value, d in zip(values, DIGITS)), *("",) * 3)
        for name, values in paper.TABLE_7.items()
        if name != "PointPillars"
    ]
    return Section(
        "Detectors by centre distance (Table 7)",
        "All methods get the same points: those in the camera's view. STM-CPA gets one labelled pedestrian per frame "
        "as its seed, PointPillars does not. PointPillars has the shipped weights, trained only on simulated scans, "
        "and its default threshold. The paper takes the values of other detectors from another study.",
        (Table("table_7", "Table 7: pedestrians by centre distance", ("method", *SCORES, *COUNTS), tuple(rows)),),
    )


def _make_overlap_section(records: list[dict]) -> Section:
    limits = len(NUMBERS.iou_limits)
    header = [
        "stage",
        *(f"{kind} IoU >= {limit:.2f} [%]" for kind in ("3D", "BEV") for limit in NUMBERS.iou_limits),
        "mean 3D IoU",
        "mean BEV IoU",
        "hits",
    ]
    scale = np.array([100.0] * 2 * limits + [1.0] * 2)
    rows: list[Row] = []
    for stage in STAGES:
        counts = stack_counts([r["overlap"][stage] for r in records], 3 + 2 * limits)
        estimates = bootstrap(counts, lambda sums: scale * divide(sums[..., 1:], sums[..., :1]))
        rows.append(
            (
                STAGE_TITLES[stage],
                *make_cells(estimates, paper.TABLE_8[stage], [1] * 2 * limits + [3, 3]),
                str(int(counts[:, 0].sum())),
            )
        )
    return Section(
        "Overlap (Table 8)",
        "IoU of the hits with the labelled boxes. Labelled boxes have a yaw; boxes of candidates are axis-aligned.",
        (Table("table_8", "Table 8: IoU of the hits", tuple(header), tuple(rows)),),
    )


def _make_runtime_section(records: list[dict]) -> Section:
    timed_records = [r for r in records if r["ms"]]
    mean_rows: list[Row] = []
    median_rows: list[Row] = []
    for name, published_values in paper.TABLE_9.items():
        ms = stack_counts([_list_step_times(r["ms"], name) for r in timed_records], len(STEPS))
        estimates = bootstrap(
            np.column_stack([np.ones(len(ms)), ms]), lambda sums: divide(sums[..., 1:], sums[..., :1])
        )
        mean_rows.append((name, *make_cells(estimates, published_values, 2)))
        medians = np.median(ms, axis=0) if len(ms) else np.full(len(STEPS), np.nan)
        median_rows.append((name, *(Cell(value, digits=2) for value in nan_to_none(medians))))
    clusters = stack_counts([r["clusters"] for r in timed_records], 2).sum(axis=0) / max(len(timed_records), 1)
    note = (
        "Preprocessing is the crop to the camera's view; ground snapping includes the RANSAC plane. "
        "Reading the files is not included. The paper gives means, on unknown hardware. "
        "Processes that run at the same time slow each other down: use --jobs 1 for clean "
        f"times. STM compares {clusters[0]:.1f} clusters per frame without the height filter, "
        f"{clusters[1]:.1f} with it."
    )
    header = ("setting", *(f"{step} [ms]" for step in STEPS))
    return Section(
        "Runtime (Table 9)",
        "",
        (
            Table("table_9", "Table 9: mean time per frame", header, tuple(mean_rows), note),
            Table("table_9_median", "Median time per frame", header, tuple(median_rows)),
        ),
    )


def _list_step_times(ms: dict[str, float], configuration: str) -> list[float]:
    """Return the times of STEPS in a configuration of Table 9."""
    height, stm, cpa = {
        "no height filter": (0.0, ms["stm_all"], 0.0),
        "height filter": (ms["height"], ms["stm"], 0.0),
        "final": (ms["height"], ms["stm"], ms["cpa"]),
    }[configuration]
    steps = [ms["view"], ms["clustering"], ms["ground"] + ms["boxes"], height, stm, cpa]
    return [*steps, sum(steps)]


def _stack_scores(records: list[dict], stage_counts: list[dict]) -> np.ndarray:
    """Return (F, 6, 5): tp, fp, fn, kept, centre error and hits of stage 1, for each range."""
    fields = ("tp", "fp", "fn", "kept", "error")
    return stack_counts(
        [
            [*(counts[k] for k in fields), record["stages"]["stage1"]["tp"]]
            for record, counts in zip(records, stage_counts)
        ],
        6,
        len(RANGE_NAMES),
    )


def _compute_scores(sums: np.ndarray) -> np.ndarray:
    """Compute SCORES of each range and in total (..., 6, 5) from sums of _stack_scores() (..., 6, 5)."""
    sums = np.concatenate([sums, sums.sum(axis=-1, keepdims=True)], axis=-1)
    tp, fp, fn, kept, error, stage1_hits = np.moveaxis(sums, -2, 0)
    kept_and_error = np.stack([100 * divide(kept, stage1_hits), divide(error, tp)], axis=-1)
    return np.concatenate([compute_rates(tp, fp, fn), kept_and_error], axis=-1)


def _make_score_row(title: str, records: list[dict], counts: list[dict], published_values: tuple) -> Row:
    """Return the row of a method over all ranges. `counts` has the counts of each frame."""
    stacked_counts = _stack_scores(records, counts)
    scores = bootstrap(stacked_counts, _compute_scores)[:, -1]
    return title, *_make_score_cells(scores, published_values), *_format_counts(stacked_counts.sum(axis=(0, 2)))


def _make_score_cells(estimates: np.ndarray, published_values: tuple) -> tuple[Cell, ...]:
    return make_cells(estimates, published_values, DIGITS)


def _format_counts(sums: np.ndarray) -> tuple[str, ...]:
    """Format COUNTS of sums (6,) of _stack_scores() over frames and ranges."""
    return tuple(str(int(value)) for value in sums[: len(COUNTS)])

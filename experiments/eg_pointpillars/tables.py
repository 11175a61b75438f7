"""Tables and figures of the EG-PointPillars experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.eg_pointpillars import paper
from experiments.eg_pointpillars.diagonals import make_diagonal_section
from experiments.eg_pointpillars.models import ALL_FRACTIONS, COMPARED_VERSIONS, group_seeds
from experiments.framework.experiment import Cell, Figure, Panel, Row, Section, Table
from experiments.framework.precision import CELLS, compare_records, from_record, resample_cells
from experiments.framework.statistics import compute_sampled_p, estimate, make_cells, make_line, nan_to_none
from experiments.framework.trained_models import TrainedModel
from lidar_perception.detectors.pointpillars.config import VERSIONS
from lidar_perception.scoring.kitti.protocol import COUNTED, SCORED, classify_labels

MEAN = len(CELLS)  # index of the mean column, see precision.compute_cells()
STRICT, RELAXED = 0, 1  # indices into precision.PROTOCOLS
MIN_AP = 20.0  # percent; below this mean BEV AP the report says that the training was too short
MIN_LABELS = 50  # with fewer labels of a class, the report says that they are too few to compare versions
TITLES = {v: "V0, PointPillars" if v == "v0" else v.upper() for v in VERSIONS}
MS_PARTS = ("total", "cpu", "experts", "network")  # times in the record of a frame
LABEL_COLUMNS = ("V0", "V4", "V4 above V0")
Draws = dict[tuple[str, float], np.ndarray]  # (version, fraction of the labels) -> array (1 + R, 2, 10)


def make_sections(records: list[dict[str, Any]], models: Mapping[str, TrainedModel]) -> list[Section]:
    """Make the report for networks that the experiment has trained, from the records of measure_frame()."""
    records = _drop_skipped(records)
    model_draws = resample_models(records, models)
    draws = average_seeds(model_draws, models)
    return [
        make_training_section(models),
        *make_version_sections(draws, records, models),
        make_label_section(draws),
        *make_seed_sections(model_draws, models),
    ]


def make_shipped_sections(records: list[dict[str, Any]], models: Mapping[str, TrainedModel]) -> list[Section]:
    """Make the report for the shipped weights from the records of measure_frame()."""
    records = _drop_skipped(records)
    text = (
        "These are the weights that ship with the package, in the size `compact`. They were trained on "
        "simulated streets. The number of steps and the initial weights differ between versions (see the "
        "research log), so a difference between two versions is not only the effect of the experts. "
        "No network was trained on a real scan."
    )
    draws = average_seeds(resample_models(records, models), models)
    return [Section("What is measured", text), *make_version_sections(draws, records, models)]


def make_version_sections(
    draws: Draws, records: list[dict[str, Any]], models: Mapping[str, TrainedModel]
) -> list[Section]:
    """Return the sections about the versions: Tables 5, 6 and 2, and Figure 13."""
    return [
        make_table_5(draws, [record["true"] for record in records]),
        make_table_6(draws, records, models),
        make_diagonal_section(records),
    ]


def resample_models(records: list[dict[str, Any]], models: Mapping[str, TrainedModel]) -> dict[str, np.ndarray]:
    """Compute the average precision of each network for samples of the frames, see resample_cells()."""
    labels = [record["true"] for record in records]
    frames_by_model = {name: compare_records(labels, [record["found"][name] for record in records]) for name in models}
    return resample_cells([record["frame"] for record in records], frames_by_model)


def average_seeds(model_draws: Mapping[str, np.ndarray], models: Mapping[str, TrainedModel]) -> Draws:
    """Average the result of resample_models() over seeds."""
    return {key: np.mean([model_draws[name] for name in group], axis=0) for key, group in group_seeds(models).items()}


def _drop_skipped(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [record for record in records if "skipped" not in record]


def make_training_section(models: Mapping[str, TrainedModel]) -> Section:
    """Return the section about the trained networks, their data and the length of their training."""
    rows: list[Row] = [
        (
            name,
            f"{100 * m.model.label_share:g} %",
            str(m.scenes),
            str(m.steps),
            str(m.best_step),
            f"{m.seconds / 60:.1f}",
            f"{m.parameters / 1e3:.1f}",
        )
        for name, m in models.items()
    ]
    return Section(
        "What was trained",
        _describe_training(next((m.model.params for m in models.values()), None)),
        (
            Table(
                "models",
                "Networks",
                ("network", "labels", "scenes", "steps", "best step", "training [min]", "parameters [thousands]"),
                tuple(rows),
            ),
        ),
    )


def _describe_training(params: Any) -> str:
    """Describe the parameters that all networks have in common. Empty if there are no networks."""
    if params is None:
        return ""
    sentences = [
        f"All networks have the size `{params.size}` and are trained with a batch size of {params.batch} for the same "
        "number of steps, starting from random weights. Networks with all labels are trained on the same "
        "scenes. The weights with the best validation score are measured."
    ]
    if params.data.scans:
        sentences.append(
            f"The scenes are simulated: {params.scene} scans of the sensor {params.sensor}, with "
            f"{params.data.people:g} times as many people as in KITTI. Validation uses "
            f"{params.data.val_scans} other scenes."
        )
    if 0 < params.ahead < 100:
        sentences.append(
            f"They were trained up to {params.ahead:g} m ahead and {params.aside:g} m to each side, but are measured "
            "in the full range."
        )
    sentences.append(
        f"The paper trains for {paper.EPOCHS} epochs on KITTI and validates every {paper.VALIDATION_EPOCHS} epochs."
    )
    return " ".join(sentences)


def make_table_5(draws: Draws, labels: list[dict[str, Any]]) -> Section:
    """Make Table 5 with the paper's overlaps, and the same table for BEV with lower overlaps.

    Args:
        draws: Average precision of the networks.
        labels: Records of the labels of all frames.
    """
    header = ("version", *(f"{name} {level}" for name, level in CELLS), "mean", "above V0", "p")
    tables = []
    for index, name, title in (
        (STRICT, "table_5", "Table 5: 3D AP [%] at the overlaps 0.7 (Car) and 0.5"),
        (RELAXED, "table_5_bev", "The same in BEV at the overlaps 0.5 (Car) and 0.25"),
    ):
        rows: list[Row] = [
            (TITLES[version], *_make_version_cells(draws, version, index))
            for version in VERSIONS
            if (version, 1.0) in draws
        ]
        tables.append(Table(name, title, header, tuple(rows)))
    counts = count_labels(labels)
    text = (
        f"{len(labels)} frames that no network was trained on, with "
        + ", ".join(f"{name} {count}" for name, count in counts.items())
        + " labels (moderate). R40, mean over seeds. Intervals and "
        "p values are from bootstrap samples of the frames, the same for all versions, so that differences "
        "are paired. The paper does not say which recall points it uses."
    )
    if rare_classes := [name for name, count in counts.items() if count < MIN_LABELS]:
        text += f" There are too few labels to compare versions by the AP of {', '.join(rare_classes)} or by the mean."
    best_ap = max((values[0, RELAXED, MEAN] for values in draws.values()), default=np.nan)
    if not best_ap >= MIN_AP:  # also true for NaN
        text = (
            "No version was trained long enough, or the frames have too few objects (mean BEV "
            f"AP {best_ap:.1f}), so neither the versions nor the numbers of labels can be compared. " + text
        )
    return Section("Versions (Table 5)", text, tuple(tables))


def count_labels(labels: list[dict[str, Any]]) -> dict[str, int]:
    """Count the moderate labels of each class in the records of the labels of all frames."""
    frames = [from_record(record) for record in labels]
    return {
        name: sum(int((classify_labels(objects, name, "moderate") == COUNTED).sum()) for objects in frames)
        for name in SCORED
    }


def _make_version_cells(draws: Draws, version: str, index: int) -> tuple[Cell, ...]:
    version_draws = draws[version, 1.0][:, index]
    is_strict = index == STRICT
    published_values = [paper.TABLE_5[version][name][i % 3] for i, (name, _) in enumerate(CELLS)]
    cells = make_cells(estimate(version_draws), [*published_values, paper.MAP[version]] if is_strict else ())
    if version == "v0" or ("v0", 1.0) not in draws:
        return (*cells, Cell(None), Cell(None))
    gain = version_draws[:, MEAN] - draws["v0", 1.0][:, index, MEAN]
    return (
        *cells,
        *make_cells(estimate(gain)[:, None], [paper.IMPROVEMENT[version]] if is_strict else ()),
        Cell(nan_to_none([compute_sampled_p(gain)])[0], digits=3),
    )


def make_table_6(draws: Draws, records: list[dict[str, Any]], models: Mapping[str, TrainedModel]) -> Section:
    """Make Table 6: gain, time per frame, overhead and number of parameters."""
    groups = {version: names for (version, fraction), names in group_seeds(models).items() if fraction == 1.0}
    ms = {version: _compute_medians(records, names) for version, names in groups.items()}
    rows: list[Row] = []
    for version, (total, cpu, experts, network) in ms.items():
        gain = draws[version, 1.0][0, STRICT, MEAN] - draws["v0", 1.0][0, STRICT, MEAN]
        base_ms = ms["v0"][0]
        values = nan_to_none([gain, total, total - base_ms, cpu, experts, network])
        is_base = version == "v0"
        rows.append(
            (
                TITLES[version],
                Cell(None if is_base else values[0], paper=paper.IMPROVEMENT.get(version), digits=2),
                Cell(values[1], paper=paper.MS[version]),
                Cell(None if is_base else values[2], paper=paper.OVERHEAD_MS.get(version)),
                *(Cell(value) for value in values[3:]),
                Cell(models[groups[version][0]].parameters / 1e3),
            )
        )
    return Section(
        "Gain and time (Table 6)",
        "Median time per frame on the machine named above; the paper's times are from a GPU. On a busy machine "
        "compare the CPU time, summed over all threads. On a CPU the versions without ground points (V1, V2, V4) "
        "skip empty cells, so they can be faster than V0. The paper's overhead of V4 contradicts its "
        "Table 5, which gives 33.3 ms.",
        (
            Table(
                "table_6",
                "Table 6",
                (
                    "version",
                    "mean 3D AP above V0 [points]",
                    "time [ms]",
                    "overhead [ms]",
                    "CPU time [ms]",
                    "ground and clusters [ms]",
                    "network [ms]",
                    "parameters [thousands]",
                ),
                tuple(rows),
            ),
        ),
    )


def _compute_medians(records: list[dict[str, Any]], names: Sequence[str]) -> np.ndarray:
    """Return the medians of MS_PARTS over frames, averaged over networks; NaN if there are no frames."""
    if not records:
        return np.full(len(MS_PARTS), np.nan)
    values = np.array([[[r["ms"][name][part] for name in names] for part in MS_PARTS] for r in records])
    return np.median(values.mean(axis=2), axis=0)


def make_label_section(draws: Draws) -> Section:
    """Return the section about V0 and V4 trained with fractions of the labelled scenes."""
    title, fractions = (
        "Dependency on labels",
        [s for s in ALL_FRACTIONS if all((v, s) in draws for v in COMPARED_VERSIONS)],
    )
    if len(fractions) < 2:
        return Section(title, "Not measured: the budget was too short to train networks with fewer labels.")
    rows: list[Row] = []
    for fraction in fractions:
        row: list[str | Cell] = [f"{100 * fraction:g} %"]
        for index in (STRICT, RELAXED):
            first, last = (draws[version, fraction][:, index, MEAN] for version in COMPARED_VERSIONS)
            row += [
                *make_cells(np.stack([estimate(d) for d in (first, last, last - first)], axis=1)),
                Cell(nan_to_none([compute_sampled_p(last - first)])[0], digits=3),
            ]
        rows.append(tuple(row))
    header = (
        "labelled scenes",
        *(
            name
            for kind in ("3D", "BEV")
            for name in (*(f"{column}, {kind} [%]" for column in LABEL_COLUMNS), f"p, {kind}")
        ),
    )
    left_out = [f"{100 * fraction:g} %" for fraction in ALL_FRACTIONS if fraction not in fractions]
    text = (
        "The paper claims that the experts reduce the dependency on "
        "labels (Sections 1 and 5), but has no experiment on it. Here both networks are trained on the same "
        "fraction of the labelled scenes for the same number of steps. Mean AP over classes and "
        "difficulties, with the overlaps of the tables above."
    )
    if left_out:
        text += f" Left out because the budget was too short: {', '.join(left_out)}."
    return Section(
        title,
        text,
        (Table("labels", "V0 and V4 by fraction of the labelled scenes", header, tuple(rows)),),
        _draw_label_figure(draws),
    )


def _draw_label_figure(draws: Draws) -> tuple[Figure, ...]:
    panels = []
    for index, title in ((STRICT, "3D, 0.7 / 0.5 / 0.5"), (RELAXED, "BEV, 0.5 / 0.25 / 0.25")):
        lines = []
        for version in COMPARED_VERSIONS:
            fractions = [fraction for fraction in ALL_FRACTIONS if (version, fraction) in draws]
            if fractions:
                values = np.stack([draws[version, fraction][:, index, MEAN] for fraction in fractions], axis=1)
                lines.append(make_line(version.upper(), [100 * s for s in fractions], estimate(values)))
        panels.append(Panel(title, "labelled scenes [%]", "mean AP", tuple(lines)))
    return (Figure("labels", "Mean AP by fraction of the labelled scenes", tuple(panels)),)


def make_seed_sections(model_draws: Mapping[str, np.ndarray], models: Mapping[str, TrainedModel]) -> list[Section]:
    """Return a section with the mean AP of each seed; [] if there is only one seed."""
    groups = group_seeds(models)
    count = max(map(len, groups.values()), default=0)
    if count < 2:
        return []
    rows: list[Row] = [
        (TITLES[version], f"{100 * fraction:g} %", *_make_seed_cells(model_draws, names, count))
        for (version, fraction), names in groups.items()
    ]
    header = ("version", "labels", *(f"seed {i}" for i in range(count)), "standard deviation")
    return [
        Section(
            "Seeds",
            "Mean 3D AP of the networks of each seed.",
            (Table("seeds", "Mean 3D AP [%] by seed", header, tuple(rows)),),
        )
    ]


def _make_seed_cells(model_draws: Mapping[str, np.ndarray], names: Sequence[str], count: int) -> tuple[Cell, ...]:
    values = [model_draws[name][0, STRICT, MEAN] for name in names]
    deviation = np.std(values, ddof=1) if len(values) > 1 else np.nan
    return tuple(map(Cell, nan_to_none([*values, *[np.nan] * (count - len(values)), deviation])))

"""Tables of the trained networks (paper C, Tables 4, 5, 6 and 8, Figure 10)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.clusters import paper
from experiments.clusters.detection import CHANGES
from experiments.clusters.networks import (
    BASELINES,
    COMPARED,
    OURS,
    RADII,
    READINGS,
    get_compared_sources,
    get_sources,
    name_model,
)
from experiments.framework.experiment import Cell, Row, Section, Table
from experiments.framework.precision import CELLS, compare_records, resample_cells
from experiments.framework.statistics import compute_sampled_p, estimate, make_cells
from experiments.framework.trained_models import TrainedModel
from lidar_perception.detectors.pointnet.config import ABLATIONS
from lidar_perception.scoring.kitti.protocol import DIFFICULTIES, SCORED

REPLICATES = 100
STRICT_3D, RELAXED_BEV, MEAN = 0, 1, len(CELLS)  # indices into the result of resample_cells()
MAX_MS = 100.0  # frame period of KITTI's sensor, for Eq. 1
MAP = ("mAP 3D [%]", "mAP BEV, relaxed [%]")
ABOUT_MAP = (
    "mAP is the mean average precision (KITTI, 40 recall points) of cars, "
    "pedestrians and cyclists at three difficulties: 3D at overlaps of 0.7 (Car) and 0.5, and "
    "BEV at 0.5 (Car) and 0.25. The paper does not name its protocol; its values are shown next to "
    "3D."
)
ABOUT_SHIPPED = (
    "Shipped: the weights of the package, trained for much longer and on other simulated scans, without recorded "
    "scans. They use gamma 0; one row uses the paper's 0.8 (Eq. 9)."
)
Draws = Mapping[str, np.ndarray]  # network -> array (1 + R, 2, 10) from resample_cells()


def make_detection_sections(
    records: list[dict[str, Any]], data: str, models: Mapping[str, TrainedModel]
) -> list[Section]:
    """Make Tables 6 and 8 from the records of measure_detection(); with trained models also Tables 4 and 5."""
    names = [r["frame"] for r in records]
    labels = [r["truth"] for r in records]
    draws = _average_seeds(
        resample_cells(
            names,
            {
                model: compare_records(labels, [r["found"][model] for r in records])
                for model in get_sources(models)
                if all(model in r["found"] for r in records)
            },
            REPLICATES,
        )
    )
    changed_draws = {
        change: _average_seeds(
            resample_cells(
                names,
                {
                    model: compare_records(labels, [r["changed"][change][model] for r in records])
                    for model in get_compared_sources(models)
                },
                REPLICATES,
            )
        )
        for change in CHANGES
    }
    return [
        *([_make_ablation_section(draws, data, models), _make_radii_section(draws, data)] if models else []),
        _make_difficulty_section(draws, data),
        _make_change_section(draws, changed_draws, records, data),
    ]


def _average_seeds(draws: Draws) -> dict[str, np.ndarray]:
    """Return the mean over the seeds of each network, by the name of the network."""
    cells_by_network: dict[str, list[np.ndarray]] = {}
    for model, cells in draws.items():
        cells_by_network.setdefault(model.split(", seed")[0], []).append(cells)
    return {network: np.mean(cells, axis=0) for network, cells in cells_by_network.items()}


def _make_map_cells(draws: np.ndarray, published_value: float | None = None) -> tuple[Cell, ...]:
    return make_cells(estimate(draws[:, :, MEAN]), (published_value, None))


def _make_gain_cells(draws: Draws, network: str, reference: str) -> Row:
    """Return the BEV mAP of a network minus that of the reference, and its p value."""
    if network == reference or reference not in draws:
        return "", ""
    gain = draws[network][:, RELAXED_BEV, MEAN] - draws[reference][:, RELAXED_BEV, MEAN]
    p = compute_sampled_p(gain)
    return *make_cells(estimate(gain[:, None])), "–" if np.isnan(p) else f"{p:.3f}"


def _make_ablation_section(draws: Draws, data: str, models: Mapping[str, TrainedModel]) -> Section:
    def make_row(network: str, reference: str, published_value: float | None) -> Row:
        trained_models = [m for name, m in models.items() if name.startswith(f"{network}, seed ")]
        minutes = float(np.mean([m.seconds for m in trained_models])) / 60
        return (
            network,
            *_make_map_cells(draws[network], published_value),
            *_make_gain_cells(draws, network, reference),
            Cell(minutes, paper=paper.MINUTES[data].get(network)),
            str(trained_models[0].parameters),
            str(trained_models[0].steps),
            str(len(trained_models)),
        )

    header = (
        "network",
        *MAP,
        "BEV above the first [points]",
        "p",
        "minutes of training",
        "parameters",
        "steps",
        "seeds",
    )
    rows = [make_row(name, "base", paper.TABLE_5[data][name]) for name in ABLATIONS if name in draws]
    rows += [make_row(name, "base", None) for name in BASELINES if name in draws]
    readings: list[Row] = [
        (text, *_make_map_cells(draws[name]), *_make_gain_cells(draws, name, OURS))
        for name, text in READINGS.items()
        if name in draws
    ]
    note = (
        "Every network is trained on the same scenes for the same number of steps. pointnet: "
        "PointNet without T-Net; pointnet2: PointNet++ with single-scale grouping. p: twice "
        "the fraction of the bootstrap samples in which the difference has the opposite sign. It does not include the "
        "variation between trainings, which needs several seeds (--seeds)."
    )
    scenes = sorted({model.scenes for model in models.values()})
    text = f"Trained on {', '.join(map(str, scenes))} scenes. {ABOUT_MAP}" if scenes else ABOUT_MAP
    return Section(
        "Ablation (Table 5)",
        text,
        (
            Table("table_5", "Table 5: parts of the method", header, tuple(rows), note),
            Table(
                "readings",
                "Centroids and density weights of the improved network",
                ("centroids and weights", *MAP, "BEV above the first [points]", "p"),
                tuple(readings),
            ),
        ),
    )


def _make_radii_section(draws: Draws, data: str) -> Section:
    published_map, nds = paper.TABLE_4[data]
    rows: list[Row] = [
        (
            f"{radii} m",
            *_make_map_cells(draws[name], published_map if name == OURS else None),
            *_make_gain_cells(draws, name, OURS),
            Cell(None, paper=nds if name == OURS else None),
        )
        for name, radii in RADII.items()
        if name in draws
    ]
    return Section(
        "Grouping radii (Table 4)",
        "The text of the paper gives only its best radii. The NDS of the trained network is in Table 7.",
        (
            Table(
                "table_4",
                "Table 4: radii of the groups",
                ("radii", *MAP, f"BEV above {RADII[OURS]} [points]", "p", "NDS [%]"),
                tuple(rows),
            ),
        ),
    )


def _make_difficulty_section(draws: Draws, data: str) -> Section:
    level_rows: list[Row] = []
    class_rows: list[Row] = []
    for network in (name for name in COMPARED if name in draws):
        cells = draws[network][:, :, :MEAN].reshape(-1, 2, len(SCORED), len(DIFFICULTIES))
        published_values = paper.TABLE_6.get(network, (None,) * 4) if data == "KITTI" else (None,) * 4
        for protocol, title in enumerate(MAP):
            means = np.concatenate([_average_classes(cells[:, protocol]), draws[network][:, protocol, MEAN:]], axis=1)
            level_rows.append(
                (network, title, *make_cells(estimate(means), published_values if protocol == STRICT_3D else ()))
            )
        for i, name in enumerate(SCORED):
            class_values = paper.FIGURE_10.get(network, {}).get(name, (None,) * 3)
            class_rows.append(
                (
                    network,
                    name,
                    *make_cells(estimate(cells[:, STRICT_3D, i]), class_values if data == "KITTI" else ()),
                    *make_cells(estimate(cells[:, RELAXED_BEV, i])),
                )
            )
    return Section(
        "Difficulties (Table 6, Figure 10)",
        f"{ABOUT_SHIPPED} {ABOUT_MAP}",
        (
            Table(
                "table_6",
                "Table 6: by difficulty, mean of the classes",
                ("network", "", *(f"{level} [%]" for level in DIFFICULTIES), "mAP [%]"),
                tuple(level_rows),
            ),
            Table(
                "figure_10",
                "Figure 10: by class and difficulty",
                (
                    "network",
                    "class",
                    *(f"3D {level} [%]" for level in DIFFICULTIES),
                    *(f"BEV, relaxed, {level} [%]" for level in DIFFICULTIES),
                ),
                tuple(class_rows),
            ),
        ),
    )


def _average_classes(cells: np.ndarray) -> np.ndarray:
    """Return the means (R, L) of cells (R, C, L) over the classes that have a value."""
    has_value = ~np.isnan(cells)
    sums = np.where(has_value, cells, 0).sum(axis=1)
    return np.divide(sums, has_value.sum(axis=1), out=np.full(sums.shape, np.nan), where=has_value.any(axis=1))


def _make_change_section(
    draws: Draws, changed_draws: Mapping[str, Draws], records: Sequence[Mapping[str, Any]], data: str
) -> Section:
    rows: list[Row] = []
    for network in (name for name in COMPARED if name in draws):
        published_values = paper.TABLE_8[data].get(network, {})
        model, all_points = name_model(network, 0), draws[network]
        for change in ("all points", *CHANGES):
            cells = all_points if change == "all points" else changed_draws[change][network]
            times = [
                r["detector_ms"][model] if change == "all points" else r["changed_ms"][change][model] for r in records
            ]
            ms = float(np.median(times)) if times else np.nan
            retention = 100 * np.divide(
                cells[:, :, MEAN],
                all_points[:, :, MEAN],
                out=np.full(cells.shape[:2], np.nan),
                where=all_points[:, :, MEAN] > 0,
            )
            rows.append(
                (
                    network,
                    change,
                    *_make_map_cells(cells, published_values.get(change)),
                    *make_cells(estimate(retention[:, RELAXED_BEV:])),
                    Cell(None if np.isnan(ms) else ms),
                    "yes" if ms <= MAX_MS else "no",
                )
            )
    return Section(
        "Fewer points and noise (Table 8, Eq. 1)",
        "Points are removed at random; noise is "
        "Gaussian, along the beams. Retention is our reading of Eq. 1: the remaining mAP in percent, "
        f"provided that the time per cloud is within the frame period of {MAX_MS:g} ms.",
        (
            Table(
                "table_8",
                "Table 8: changed clouds",
                ("network", "change", *MAP, "retention of BEV [%]", "time of a cloud [ms]", "in time"),
                tuple(rows),
                "Networks of the first seed. Times are medians on the machine named above; the paper reports 31 to 33 "
                "frames per second, on unknown hardware.",
            ),
        ),
    )

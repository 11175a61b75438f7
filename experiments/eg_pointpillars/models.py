"""The networks of the experiment: five versions, and V0 and V4 trained with fewer labelled scenes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from experiments.eg_pointpillars import paper
from experiments.framework.trained_models import Model, TrainedModel, count_parameters
from lidar_perception.detectors.checkpoint import read_header
from lidar_perception.detectors.pointpillars.config import VERSIONS
from lidar_perception.detectors.pointpillars.params import PointPillarsParams
from lidar_perception.detectors.weights_file import find_pointpillars_weights
from lidar_perception.param_fields import with_values
from lidar_perception.training.params import PointPillarsTraining

TRAINING = PointPillarsTraining()
# Full range, network size and number of epochs as in Section 4.1.
PROTOCOL = {
    "size": "full",
    "score": "map",
    "epochs": float(paper.EPOCHS),
    "validate_epochs": float(paper.VALIDATION_EPOCHS),
    "ahead": 1000.0,
    "aside": 1000.0,
}
STUDIED = "v0", "v4"  # versions in the study of label counts
SHARES = (0.1, 0.25, 0.5)  # fractions of the labelled scenes, in addition to all of them, in order of importance
ALL_SHARES = (*SHARES, 1.0)


def choose_models(params: PointPillarsTraining, seed: int) -> list[Model]:
    """Return the networks of a seed: all versions, then those of the study of labels."""

    def make(version: str, share: float) -> Model:
        return Model(
            name_model(version, share, seed),
            with_values(params, {"version": version, "seed": seed}),
            share,
            required=share == 1.0,
        )

    return [
        *(make(version, 1.0) for version in VERSIONS),
        *(make(version, share) for share in SHARES for version in STUDIED),
    ]


def read_shipped_models() -> dict[str, TrainedModel]:
    """Return the compact networks that ship with the package, by version.

    Their steps, seconds and scenes are those of their last training.
    """
    shipped = {}
    for version in VERSIONS:
        file = find_pointpillars_weights(PointPillarsParams(version=version, size="compact"))
        last = read_header(file).training
        model = Model(version.upper(), with_values(TRAINING, {"version": version}))
        shipped[model.name] = TrainedModel(
            model, file, last["steps"], last["seconds"], last["steps"], last["scenes"], count_parameters(file)
        )
    return shipped


def name_model(version: str, share: float, seed: int) -> str:
    """Return the name of a network, such as "V4, 25 % of the labels, seed 0"."""
    labels = "" if share == 1.0 else f", {100 * share:g} % of the labels"
    return f"{version.upper()}{labels}, seed {seed}"


def group_seeds(models: Mapping[str, TrainedModel]) -> dict[tuple[str, float], list[str]]:
    """Return (version, share of the labels) -> names of the networks of all seeds."""
    groups: dict[tuple[str, float], list[str]] = {}
    for name, trained in models.items():
        params: Any = trained.model.params
        groups.setdefault((params.version, trained.model.label_share), []).append(name)
    return groups

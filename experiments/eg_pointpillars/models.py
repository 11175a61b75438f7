"""Networks of the experiment: five versions, and V0 and V4 trained with fewer labelled scenes."""

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
# Full range; network size and number of epochs as in Section 4.1.
PROTOCOL = {
    "size": "full",
    "score": "map",
    "epochs": float(paper.EPOCHS),
    "validate_epochs": float(paper.VALIDATION_EPOCHS),
    "ahead": 1000.0,
    "aside": 1000.0,
}
COMPARED_VERSIONS = "v0", "v4"  # versions in the study of label counts
FRACTIONS = (0.1, 0.25, 0.5)  # fractions of the labelled scenes, most important first
ALL_FRACTIONS = (*FRACTIONS, 1.0)


def choose_models(params: PointPillarsTraining, seed: int) -> list[Model]:
    """Return the networks to train with this seed: all versions, then those with fewer labels."""

    def make_model(version: str, fraction: float) -> Model:
        return Model(
            name_model(version, fraction, seed),
            with_values(params, {"version": version, "seed": seed}),
            fraction,
            required=fraction == 1.0,
        )

    return [
        *(make_model(version, 1.0) for version in VERSIONS),
        *(make_model(version, fraction) for fraction in FRACTIONS for version in COMPARED_VERSIONS),
    ]


def read_shipped_models() -> dict[str, TrainedModel]:
    """Return the compact networks that ship with the package, by version.

    Their steps, seconds and scenes are those of their last training run.
    """
    models = {}
    for version in VERSIONS:
        file = find_pointpillars_weights(PointPillarsParams(version=version, size="compact"))
        training = read_header(file).training
        model = Model(version.upper(), with_values(TRAINING, {"version": version}))
        models[model.name] = TrainedModel(
            model,
            file,
            training["steps"],
            training["seconds"],
            training["steps"],
            training["scenes"],
            count_parameters(file),
        )
    return models


def name_model(version: str, fraction: float, seed: int) -> str:
    """Return the name of a network, such as "V4, 25 % of the labels, seed 0"."""
    labels = "" if fraction == 1.0 else f", {100 * fraction:g} % of the labels"
    return f"{version.upper()}{labels}, seed {seed}"


def group_seeds(models: Mapping[str, TrainedModel]) -> dict[tuple[str, float], list[str]]:
    """Group networks that differ only in the seed: (version, fraction of the labels) -> names."""
    groups: dict[tuple[str, float], list[str]] = {}
    for name, trained_model in models.items():
        params: Any = trained_model.model.params
        groups.setdefault((params.version, trained_model.model.label_share), []).append(name)
    return groups

"""Networks of the experiment of paper C: networks that it trains, and detectors with shipped weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from experiments.framework.trained_models import Model, TrainedModel
from lidar_perception.detectors.pointnet.config import ABLATIONS
from lidar_perception.detectors.pointnet.params import PointNetParams
from lidar_perception.detectors.pointpillars.params import PointPillarsParams
from lidar_perception.detectors.weights_file import find_pointnet_weights, find_pointpillars_weights
from lidar_perception.param_fields import with_values
from lidar_perception.training.params import PointNetTraining


class DetectorSource(NamedTuple):
    """A detector.

    Attributes:
        weights: Checkpoint.
        gamma: Gamma of its clustering (Eq. 9); None for the value it was trained with.
    """

    weights: Path
    gamma: float | None = None


OURS = "improved"
BASELINES = ("pointnet", "pointnet2")
SHIPPED = {
    "PointNet, shipped": DetectorSource(find_pointnet_weights(PointNetParams())),
    "PointNet, shipped, gamma 0.8": DetectorSource(find_pointnet_weights(PointNetParams()), 0.8),
    "PointPillars V0, shipped": DetectorSource(find_pointpillars_weights(PointPillarsParams(version="v0"))),
}
COMPARED = (OURS, *BASELINES, *SHIPPED)  # compared by difficulty, on modified clouds and on drives
RADII = {
    "radii-halved": "0.05, 0.1, 0.2",
    OURS: "0.1, 0.2, 0.4",
    "radii-doubled": "0.2, 0.4, 0.8",
    "radii-quadrupled": "0.4, 0.8, 1.6",
}
READINGS = {
    OURS: "first points, neighbours per radius",
    "farthest": "farthest points (Eq. 15)",
    "ball-density": "points per volume (Eq. 17)",
    "farthest-ball-density": "both",
}
REQUIRED = (OURS, *(name for name in ABLATIONS if name != OURS), *BASELINES)
NETWORKS = (*REQUIRED, *(name for name in (*RADII, *READINGS) if name != OURS))


def choose_networks(params: PointNetTraining, seed: int) -> Sequence[Model]:
    """Return the networks to train with this seed, the most important ones first."""
    return [
        Model(name_model(name, seed), with_values(params, {"network": name, "seed": seed}), required=name in REQUIRED)
        for name in NETWORKS
    ]


def name_model(network: str, seed: int) -> str:
    """Return the name of a detector in the records. Networks that are trained here have a seed in their name."""
    return network if network in SHIPPED else f"{network}, seed {seed}"


def get_sources(models: Mapping[str, TrainedModel]) -> dict[str, DetectorSource]:
    """Return all detectors by their name in the records."""
    return {**{name: DetectorSource(model.weights) for name, model in models.items()}, **SHIPPED}


def get_compared_sources(models: Mapping[str, TrainedModel]) -> dict[str, DetectorSource]:
    """Return the detectors in COMPARED by their name in the records; trained ones with the first seed."""
    sources = get_sources(models)
    return {name: sources[name] for name in (name_model(n, 0) for n in COMPARED) if name in sources}

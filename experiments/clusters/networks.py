"""The networks of paper C's experiment, all trained on the same scenes with the same steps."""

from __future__ import annotations

from collections.abc import Sequence

from experiments.framework.trained_models import Model
from lidar_perception.detectors.pointnet.config import ABLATIONS
from lidar_perception.param_fields import with_values
from lidar_perception.training.params import PointNetTraining

OURS = "improved"
BASELINES = ("pointnet", "pointnet2")
COMPARED = (OURS, *BASELINES)  # networks compared by difficulty, on modified clouds and on drives
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
    """Return the networks to train with a seed, the most important ones first."""
    return [
        Model(name_model(name, seed), with_values(params, {"network": name, "seed": seed}), required=name in REQUIRED)
        for name in NETWORKS
    ]


def name_model(network: str, seed: int) -> str:
    """Return the name of a trained network."""
    return f"{network}, seed {seed}"

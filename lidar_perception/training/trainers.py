"""Choice of the trainer by the parameters of the training."""

from __future__ import annotations

from typing import Any

from lidar_perception.detectors.pointnet.config import make_pointnet_config
from lidar_perception.detectors.pointpillars.config import RANGES, make_config
from lidar_perception.training.params import PointNetTraining, PointPillarsTraining
from lidar_perception.training.pointnet.trainer import PointNetTrainer, find_proposer
from lidar_perception.training.pointpillars.trainer import PointPillarsTrainer
from lidar_perception.training.trainer import Trainer


def make_trainer(params: PointPillarsTraining | PointNetTraining) -> Trainer:
    """Make the trainer for these parameters. Raise InputError if params.proposer has no weights."""
    if isinstance(params, PointNetTraining):
        find_proposer(params)
        return PointNetTrainer(make_pointnet_config(params.network))
    detection_range: dict[str, Any] = {**RANGES["around"]} if params.range == "around" else {}  # default: ahead
    return PointPillarsTrainer(make_config(params.version, params.size, **detection_range))

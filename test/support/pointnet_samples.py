"""Small cluster networks and detectors for the tests of PointNet; scenes: detection_samples."""

from __future__ import annotations

import numpy as np
import torch

from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.pointnet.classifier import PointNetClassifier
from lidar_perception.detectors.pointnet.clusters import Clusters
from lidar_perception.detectors.pointnet.config import PointNetConfig, make_pointnet_config
from lidar_perception.detectors.pointnet.detector import PointNetDetector
from lidar_perception.detectors.pointnet.network import CONTEXT, PointNet, fuse_norms
from lidar_perception.detectors.pointnet.params import PointNetDetectorParams
from lidar_perception.detectors.pointnet.torch_network import TorchPointNet
from lidar_perception.param_fields import with_values

CPU = "cpu"
SMALL = dict(
    points=32,
    centroids=12,
    coarse=4,
    neighbours=(4, 6, 8),
    coarse_neighbours=4,
    point_channels=(8, 8),
    group_channels=(8, 8),
    local_channels=12,
    global_channels=16,
    head_channels=(16,),
)


def make_small_config(name: str = "improved", **changes) -> PointNetConfig:
    """Return the configuration of a network with few channels."""
    return make_pointnet_config(name, **{**SMALL, **changes})


def make_random_network(config: PointNetConfig, seed: int = 0) -> PointNet:
    """Return a network in eval mode whose norms were updated with random clusters, so that outputs differ between
    clusters."""
    torch.manual_seed(seed)
    network = PointNet(config)
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm1d):
            torch.nn.init.uniform_(module.weight, 0.5, 1.5)
            torch.nn.init.normal_(module.bias, std=0.3)
            module.momentum = 1.0
    torch.nn.init.normal_(network.classes.weight, std=0.5)
    clusters = (
        torch.randn(64, config.points, 5) * torch.tensor([2.0, 1, 1, 0.5, 1]) * torch.rand(64, 1, 5),
        torch.ones(64, config.points, dtype=torch.bool),
        torch.rand(64, CONTEXT) * 2,
    )
    with torch.no_grad():
        network(*clusters)  # updates the norms
        logits = network.eval()(*clusters).logits
        network.classes.bias -= logits.mean(dim=0)  # makes all classes equally likely
    return network.requires_grad_(False)


def accept_every_cluster(
    params: PointNetDetectorParams = PointNetDetectorParams(), score: float = 0.0
) -> PointNetDetectorParams:
    """Return parameters with which random weights detect something; a score of 0 accepts every cluster."""
    return with_values(
        params,
        {f"pointnet.scores.{name}": score for name in ("car", "pedestrian", "cyclist", "other")}
        | {"pointnet.nms.iou": 0.9},
    )


def make_classifier(network: PointNet, header: Header, engine: str = "auto") -> PointNetClassifier:
    """Return a network in eval mode as a classifier."""
    return PointNetClassifier(TorchPointNet(fuse_norms(network), engine), header)


def make_random_detector(params: PointNetDetectorParams | None = None, **changes) -> PointNetDetector:
    """Return a PointNet detector with random weights."""
    config = make_small_config(**changes)
    return PointNetDetector(
        make_classifier(make_random_network(config), Header(config)), params or accept_every_cluster()
    )


def make_blobs(rng, sizes, spread=0.4):
    """Return clusters with the given numbers of points, each around its own centre."""
    middles = rng.uniform(-30, 30, (len(sizes), 3)) * [1, 1, 0.03]
    number = np.repeat(np.arange(len(sizes)), sizes)
    xyz = middles[number] + rng.normal(0, spread, (len(number), 3))
    points = np.column_stack([xyz, rng.random(len(number))]).astype(np.float32)
    return Clusters(points, np.concatenate([[0], np.cumsum(sizes)]), np.arange(1, len(sizes) + 1))

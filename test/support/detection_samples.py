"""Small networks and detectors, and a scene of two objects, for the tests of detection."""

from __future__ import annotations

import numpy as np
import torch

from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.detectors.pointpillars.anchors import get_anchor_classes, make_anchors
from lidar_perception.detectors.pointpillars.config import NetworkConfig, make_config
from lidar_perception.detectors.pointpillars.detector import CPU, PointPillarsDetector
from lidar_perception.detectors.pointpillars.network import make_network
from lidar_perception.detectors.pointpillars.params import DetectorParams
from lidar_perception.detectors.pointpillars.prediction import Network
from lidar_perception.detectors.pointpillars.proposer import PointPillarsProposer
from lidar_perception.detectors.pointpillars.torch_network import TorchNetwork
from lidar_perception.param_fields import with_values
from lidar_perception.types import Detections, PointCloud

# A car seen from the side and a pedestrian on the ground 1.73 m below [x y z l w h yaw].
BOXES = torch.tensor([[6.0, 1.5, -0.95, 3.9, 1.7, 1.5, 1.2], [3.0, -2.5, -0.86, 0.8, 0.7, 1.7, -2]])
LABELS = torch.tensor([0, 1])


def make_tiny_config(version: str = "v0", **changes) -> NetworkConfig:
    """Return the configuration of a version with 32 x 32 pillars and few channels."""
    small = dict(
        low=(0.0, -5.12, -3.0),
        high=(10.24, 5.12, 1.0),
        cell=0.32,
        pillar_channels=8,
        map_channels=(4, 8),
        block_channels=(8, 12, 16),
        block_layers=(1, 1, 1),
        deconv_channels=8,
        fpn_channels=8,
    )
    return make_config(version, "compact", **{**small, **changes})


def make_anchor_tensors(config: NetworkConfig) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the anchors (A, 7) of a network and their classes (A,)."""
    return torch.from_numpy(make_anchors(config)), torch.from_numpy(get_anchor_classes(config))


def make_two_objects(seed: int = 0) -> np.ndarray:
    """Return flat ground with the surfaces of BOXES on it, (N, 4) float32 [x y z intensity]."""
    rng = np.random.default_rng(seed)
    parts = [rng.uniform([0, -5, -1.74], [10, 5, -1.72], (3000, 3))]
    for x, y, z, length, width, height, yaw in BOXES.tolist():
        flat = rng.uniform(-0.5, 0.5, (300, 3))
        side = rng.integers(0, 2, 300)
        flat[np.arange(300), side] = np.sign(flat[np.arange(300), side]) / 2
        flat *= [length, width, height]
        cos, sin = np.cos(yaw), np.sin(yaw)
        parts.append(
            np.column_stack(
                [x + cos * flat[:, 0] - sin * flat[:, 1], y + sin * flat[:, 0] + cos * flat[:, 1], z + flat[:, 2]]
            )
        )
    xyz = np.concatenate(parts)
    return np.column_stack([xyz, rng.uniform(0, 1, len(xyz))]).astype(np.float32)


def make_random_network(config, seed=0) -> torch.nn.Module:
    """Return a network in eval mode whose norms and head differ from their initial values."""
    torch.manual_seed(seed)
    network = make_network(config).eval()
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm1d | torch.nn.BatchNorm2d):
            torch.nn.init.uniform_(module.weight, 0.5, 1.5)
            torch.nn.init.normal_(module.bias, std=0.3)
            module.running_mean.normal_(std=0.3)
            module.running_var.uniform_(0.5, 2)
    torch.nn.init.normal_(network.head.scores.weight, std=0.3)
    torch.nn.init.constant_(network.head.scores.bias, -1.0)
    torch.nn.init.normal_(network.head.codes.weight, std=0.1)
    return network.requires_grad_(False)


def make_scan(seed: int = 0) -> PointCloud:
    """Return a frame with the two objects, and points behind the sensor and far away."""
    points = make_two_objects(seed)
    points = np.concatenate([points, points[::7] * [-1, 1, 1, 1], points[::9] + [50, 0, 0, 0]])
    points = points.astype(np.float32)
    return PointCloud(np.ascontiguousarray(points[:, :3]), points[:, 3].copy())


def lower_thresholds(
    params: DetectorParams = DetectorParams(), score: float = 0.25, engine: str = "auto"
) -> DetectorParams:
    """Return parameters with which random weights detect something."""
    names = ("car", "pedestrian", "cyclist", "other")
    return with_values(
        params,
        {
            **{f"pointpillars.scores.{n}": score for n in names},
            "pointpillars.nms.iou": 0.2,
            "pointpillars.engine": engine,
        },
    )


def make_random_detector(version: str = "v0", params: DetectorParams | None = None, **changes) -> PointPillarsDetector:
    """Return a PointPillars detector with random weights."""
    return make_detector(
        TorchNetwork(make_random_network(make_tiny_config(version, **changes))),
        Header(make_tiny_config(version, **changes)),
        params or lower_thresholds(),
    )


def make_detector(
    network: Network, header: Header, params: DetectorParams = DetectorParams(), device: str = CPU
) -> PointPillarsDetector:
    return PointPillarsDetector(PointPillarsProposer(network, header, device), params)


def are_equal_detections(a: Detections | DetectionResult, b: Detections | DetectionResult, atol: float = 0.0) -> bool:
    """Return True if the detections are equal and in the same order."""
    a, b = (x.detections if isinstance(x, DetectionResult) else x for x in (a, b))
    return (
        len(a) == len(b)
        and np.array_equal(a.class_ids, b.class_ids)
        and np.allclose(a.boxes, b.boxes, rtol=0, atol=atol)
        and np.allclose(a.scores, b.scores, rtol=0, atol=atol)
    )

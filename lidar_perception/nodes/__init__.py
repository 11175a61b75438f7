"""rclpy nodes, which convert messages, call the core and publish results.

Only this part of the package needs ROS.
"""

import importlib
from typing import Any

_BOXES, _DETECTIONS = "params.BoxNodeParams", "params.DetectionNodeParams"
# Executable -> node class (relative to lidar_perception.nodes) and parameter dataclasses
# (relative to lidar_perception). scripts/nodes has a link for each name.
NODES = {
    "bag_player": ("replay.bag_player.BagPlayer", "params.PlayerParams"),
    "bag_recorder": ("replay.bag_recorder.BagRecorder", "params.RecorderParams"),
    "ground_segmentation": (
        "ground_segmentation.GroundSegmentation",
        "params.GroundNodeParams",
        "params.GroundExtraParams",
    ),
    "clustering": ("clustering.Clustering", "params.ClusteringNodeParams", _BOXES),
    "candidate_refinement": ("candidate_refinement.CandidateRefinement", "params.RefinementNodeParams", _DETECTIONS),
    "evaluator": ("replay.evaluator.Evaluator", "params.EvaluatorParams"),
    "perception": ("perception.Perception", "candidates.params.PipelineParams", "params.PerceptionExtraParams"),
    "pointpillars_detector": (
        "pointpillars_detector.PointPillarsNode",
        "detectors.pointpillars.params.DetectorParams",
        _DETECTIONS,
    ),
    "pointnet_detector": (
        "pointnet_detector.PointNetNode",
        "detectors.pointnet.params.PointNetDetectorParams",
        _DETECTIONS,
    ),
    "fused_detector": ("fused_detector.FusedNode", "detectors.fused.params.FusedDetectorParams", _DETECTIONS),
    "tracker": ("tracker.TrackerNode", "params.TrackerNodeParams", "params.TrackerExtraParams"),
}


def load_node_class(name: str) -> Any:
    """Import and return the class of a node, given the name of its executable."""
    module, _, class_name = NODES[name][0].rpartition(".")
    return getattr(importlib.import_module(f"lidar_perception.nodes.{module}"), class_name)


def require_rclpy() -> None:
    """Raise InputError if rclpy is not installed or cannot be loaded."""
    from lidar_perception.types import InputError

    try:
        import rclpy  # noqa: F401
    except ImportError as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"cannot load rclpy ({reason}): source ROS 2 Jazzy, or pip install 'lidar_perception[ros]'"
        ) from None

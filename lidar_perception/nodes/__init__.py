"""rclpy nodes: convert, call the core, publish. The only part of the package that needs ROS."""

_BOXES, _DETECTIONS = "params.BoxNodeParams", "params.DetectionNodeParams"
# Executable -> its class, in the module of the executable's name, and its parameters. scripts/nodes
# has a link of each name.
NODES = {
    "bag_player": ("BagPlayer", "params.PlayerParams"),
    "bag_recorder": ("BagRecorder", "params.RecorderParams"),
    "ground_segmentation": ("GroundSegmentation", "params.GroundNodeParams",
                            "params.GroundRobotParams"),
    "clustering": ("Clustering", "params.ClusteringNodeParams", _BOXES),
    "candidate_refinement": ("CandidateRefinement", "params.RefinementNodeParams",
                             _DETECTIONS),
    "evaluator": ("Evaluator", "params.EvaluatorParams"),
    "perception": ("Perception", "candidates.params.PipelineParams",
                   "params.PerceptionRobotParams"),
    "pointpillars_detector": ("PointPillarsNode", "detectors.pointpillars.params.DetectorParams",
                              _DETECTIONS),
    "pointnet_detector": ("PointNetNode", "detectors.pointnet.params.PointNetDetectorParams",
                          _DETECTIONS),
    "fused_detector": ("FusedNode", "detectors.fused.params.FusedDetectorParams", _DETECTIONS),
    "tracker": ("TrackerNode", "params.TrackerNodeParams", "params.TrackInputParams"),
}


def require_rclpy() -> None:
    """InputError where rclpy is not installed, or cannot be loaded."""
    from lidar_perception.types import InputError
    try:
        import rclpy  # noqa: F401
    except ImportError as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"cannot load rclpy ({reason}): source ROS 2 Jazzy, or pip install "
                         "'lidar_perception[ros]'") from None

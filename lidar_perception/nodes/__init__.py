"""rclpy nodes: convert, call the core, publish. The only part of the package that needs ROS."""

_BOXES = "params.BoxNodeParams"
# Executable -> its class, in the module of the executable's name, and its parameters. setup.py
# reads this table too.
NODES = {
    "bag_player": ("BagPlayer", "params.PlayerParams"),
    "bag_recorder": ("BagRecorder", "params.RecorderParams"),
    "ground_segmentation": ("GroundSegmentation", "params.GroundNodeParams",
                            "params.GroundRobotParams"),
    "clustering": ("Clustering", "params.ClusteringNodeParams", _BOXES),
    "candidate_refinement": ("CandidateRefinement", "params.RefinementNodeParams",
                             "params.CANDIDATES"),
    "evaluator": ("Evaluator", "params.EvaluatorParams"),
    "perception": ("Perception", "candidates.params.PipelineParams",
                   "params.PERCEPTION"),
    "pointpillars_detector": ("PointPillarsNode", "detectors.pointpillars.params.DetectorParams",
                              "params.POINTPILLARS"),
    "pointnet_detector": ("PointNetNode", "detectors.pointnet.params.PointNetDetectorParams",
                          "params.POINTNET"),
    "fused_detector": ("FusedNode", "detectors.fused.params.FusedDetectorParams", "params.FUSED"),
    "tracker": ("TrackerNode", "params.TrackerNodeParams", "params.TrackInputParams"),
}

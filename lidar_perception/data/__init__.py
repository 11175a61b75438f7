"""Labelled frames: KITTI, nuScenes and SemanticKITTI folders, and rosbag2 bags."""

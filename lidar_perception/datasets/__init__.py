"""Recorded data: KITTI folders and rosbag2 bags."""

"""LiDAR perception on NumPy arrays, with thin ROS 2 nodes around it."""

__version__ = "0.1.0"

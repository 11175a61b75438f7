"""Recordings: bags, data sets and point cloud files, read and written without ROS."""

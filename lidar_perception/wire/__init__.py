"""Conversion between ROS messages and the types of the library, without ROS."""

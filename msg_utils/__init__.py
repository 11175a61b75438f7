"""Conversion between ROS messages and NumPy arrays.

Functions that build messages take a function `make(type_name, **fields)`, which returns a message
with default values in all other fields. Pass messages.make_ros_message, or without ROS a function
that builds rosbags classes. Functions that read messages accept both kinds of classes.
"""

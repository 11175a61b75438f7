"""Conversion between ROS messages and NumPy arrays.

Functions that build messages take a callable `make(type_name, **fields)`, which returns a message
whose other fields have their defaults: messages.make_ros_message, or without ROS one that builds
rosbags' classes. Functions that read messages accept both kinds of classes.
"""

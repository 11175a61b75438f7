"""Conversion between ROS messages and NumPy arrays; needs NumPy and message classes only.

Functions that build messages take a callable `make(type_name, **fields)`, which returns a message
with every other field at its default: messages.make_ros_message if ROS is installed, or one that
builds rosbags' classes, so that bags can be written without ROS. Functions that read messages take
both kinds of classes.
"""

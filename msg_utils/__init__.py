"""ROS messages <-> NumPy arrays. NumPy and message classes only; knows nothing of the algorithms.

Functions that build messages take a `make` callable, make(type_name, **fields) -> message with
every other field at its default: messages.ros_message where ROS is installed, or one that builds
rosbags' own classes, so that bags can be written without ROS. Functions that read messages take
either kind.
"""

"""Messages to the core's types and back, without ROS."""

"""rclpy nodes: convert, call the core, publish. The only part of the package that needs ROS."""

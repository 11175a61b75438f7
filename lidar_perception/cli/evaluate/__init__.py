"""evaluate: the algorithms against labels, without ROS."""

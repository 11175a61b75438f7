"""evaluate: score algorithms against labels, without ROS."""

"""Multi-object tracking: ids, velocities and steadier detections, also on a moving robot."""

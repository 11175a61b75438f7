"""Multi-object tracking: track ids, velocities and smoothed boxes, also on a moving robot."""

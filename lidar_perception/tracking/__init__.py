"""Tracks: ids, velocities and steadier detections over time, also on a moving robot."""

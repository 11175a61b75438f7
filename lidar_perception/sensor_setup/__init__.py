"""Measures a LiDAR and its mounting from unlabelled clouds."""

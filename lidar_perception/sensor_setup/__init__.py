"""Measurement of a LiDAR and its mounting from clouds, and the files that describe them."""

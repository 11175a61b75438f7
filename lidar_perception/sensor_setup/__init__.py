"""Measurement of a LiDAR and its mounting from clouds, and the files and the report about it."""

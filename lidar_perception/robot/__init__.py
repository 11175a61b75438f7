"""Sensor on a robot: crop, mounting, coordinate frames and motion correction."""

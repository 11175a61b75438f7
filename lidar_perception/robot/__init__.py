"""The sensor on its robot: crop, mounting, coordinate frames and motion correction."""

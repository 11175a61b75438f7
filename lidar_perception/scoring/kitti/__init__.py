"""Scores as in KITTI's object benchmark."""

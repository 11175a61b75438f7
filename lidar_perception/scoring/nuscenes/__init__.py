"""Scores as in nuScenes' detection task."""

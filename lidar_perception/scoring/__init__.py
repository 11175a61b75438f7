"""Scores of detections, tracks, ground and clusters on labelled recordings."""

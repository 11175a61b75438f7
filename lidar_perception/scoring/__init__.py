"""Detections, ground and clusters against labels."""

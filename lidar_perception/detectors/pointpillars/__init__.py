"""Learned detectors: EG-PointPillars (paper B), from a cloud to boxes."""

"""EG-PointPillars (paper B), a network that detects boxes in a cloud."""

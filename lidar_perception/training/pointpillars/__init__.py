"""Training of PointPillars."""

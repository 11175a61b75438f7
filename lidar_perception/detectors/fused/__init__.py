"""The fused detector: PointPillars, PointNet and silhouettes, combined to one probability."""

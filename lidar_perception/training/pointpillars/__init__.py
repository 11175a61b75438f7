"""What PointPillars is trained with."""

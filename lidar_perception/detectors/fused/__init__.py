"""One detector of several: PointPillars, the cluster network and silhouettes, weighed together."""

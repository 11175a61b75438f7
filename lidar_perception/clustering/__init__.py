"""Clustering of points: (N, 3) -> (N,) int32 ids, 0 for no cluster, 1..K for the clusters."""

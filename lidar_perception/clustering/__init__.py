"""Points to cluster ids: (N, 3) -> (N,) int32, 0 = none, 1..K."""

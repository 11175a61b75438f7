"""Two detectors that check each other: what one finds is scored again by the cluster network."""

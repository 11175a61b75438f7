"""The tables of paper C: adaptive Euclidean clustering and the improved PointNet."""

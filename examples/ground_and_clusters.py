"""Segment the ground and clusters of an array of points: python examples/ground_and_clusters.py [cloud.npy]."""

import sys

import numpy as np

import lidar_perception as lp

if sys.argv[1:]:
    points = np.load(sys.argv[1])  # (N, 3) x y z or (N, 4) x y z intensity
else:
    points = lp.simulate(1).frames[0].load().points()
for method in "threshold", "patchwork", "cloth":
    ground = lp.segment_ground(points, method, sensor_height=1.73)
    cluster_ids = lp.cluster(points, ground=ground)
    print(f"{method}: {ground.mean():.0%} of {len(points)} points are ground, {cluster_ids.max()} clusters")
people = lp.find_candidates(points)
print(f"{len(people)} pedestrian candidates at x y z:", *people.boxes[:, :3].round(1).tolist())

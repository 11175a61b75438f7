"""Makes docs/images/scene.png, a simulated scan with its ground, its clusters and the boxes of the
PointPillars v4 that comes with the package, in perspective: python docs/picture.py
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection, PolyCollection

from lidar_perception.clustering.cluster import cluster
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.pointpillars.params import DetectorParams
from lidar_perception.geometry import box_corners, points_in_box
from lidar_perception.ground.segment import segment_ground
from lidar_perception.simulation.drive import scan_at
from lidar_perception.simulation.scene import Streets
from lidar_perception.simulation.sensor import HDL64E
from lidar_perception.types import CLASSES, Detections, LidarFrame

SEED, STREETS = 9, Streets("zone", people=3.0)
PICTURE = Path(__file__).parent / "images" / "scene.png"
# A pinhole camera, in the frame of the points: metres, pixels, degrees from edge to edge.
EYE, TARGET, FOV, WIDTH, HEIGHT = (-9.0, -4.5, 5.2), (14.0, 1.6, -0.9), 58.0, 1600, 720
NEAR, POINT = 0.3, 0.024  # metres before the eye, and a point's radius

EDGES = [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6],
         [3, 7]]
FACES = [[0, 3, 7, 4], [1, 2, 6, 5], [0, 1, 5, 4], [2, 3, 7, 6], [4, 5, 6, 7]]  # the front first
SKY, FLOOR = (0.035, 0.05, 0.085), (0.075, 0.095, 0.14)
GROUND, REST = (0.36, 0.47, 0.62), (0.55, 0.60, 0.68)
# Neighbouring clusters differ; muted, so that boxes stand out.
CLUSTERS = np.array([
    [0.56, 0.47, 0.86], [0.33, 0.65, 0.62], [0.82, 0.56, 0.66], [0.50, 0.68, 0.38],
    [0.38, 0.56, 0.85], [0.80, 0.65, 0.42], [0.68, 0.42, 0.68], [0.42, 0.70, 0.80],
    [0.76, 0.50, 0.44], [0.58, 0.62, 0.46]])
CLASS_COLORS = {"Car": (0.20, 0.80, 1.00), "Pedestrian": (1.00, 0.42, 0.32),
                "Cyclist": (1.00, 0.82, 0.22)}


def project(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (..., 2), column and row, and metres ahead of the eye (...) of points (..., 3)."""
    ahead = np.subtract(TARGET, EYE) / np.linalg.norm(np.subtract(TARGET, EYE))
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    seen = (xyz - np.array(EYE)) @ np.stack([right, np.cross(ahead, right), ahead]).T
    depth = np.maximum(seen[..., 2], NEAR)
    return seen[..., :2] / depth[..., None] * focal() + [WIDTH / 2, HEIGHT / 2], seen[..., 2]


def focal() -> float:
    """Pixels."""
    return WIDTH / 2 / np.tan(np.radians(FOV) / 2)


def draw_scene(path: Path, frame: LidarFrame, ground: np.ndarray, cluster_ids: np.ndarray,
               found: Detections) -> None:
    """Draw from far to near: the points behind a box, its faces, what is before it; edges last."""
    colors = np.where(ground[:, None], GROUND, REST)
    clustered = (cluster_ids > 0) & ~ground
    colors[clustered] = CLUSTERS[cluster_ids[clustered] * 7 % len(CLUSTERS)]
    box_colors = [np.array(CLASS_COLORS[CLASSES[i]]) for i in found.class_ids]
    for box, color in zip(found.boxes, box_colors):
        colors[points_in_box(frame.xyz, box, 0.1) & ~ground] = 0.45 + 0.55 * color
    pixels, depth = project(frame.xyz.astype(float))
    order = np.argsort(-depth)
    order = order[depth[order] > NEAR]

    figure = plt.figure(figsize=(WIDTH / 100, HEIGHT / 100), dpi=100)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, WIDTH), ylim=(HEIGHT, 0))
    axes.axis("off")
    sky = np.linspace(SKY, FLOOR, HEIGHT)[:, None]
    axes.imshow(sky, extent=(0, WIDTH, HEIGHT, 0), aspect="auto")

    def draw_points(rows: np.ndarray, layer: int) -> None:
        radius = np.clip(POINT * focal() / depth[rows], 0.6, 2.2)
        axes.scatter(*pixels[rows].T, s=(2 * radius * 0.72) ** 2, linewidths=0, zorder=layer,
                     c=np.column_stack([colors[rows], np.exp(-depth[rows] / 110)]))

    corners = box_corners(found.boxes.astype(float))
    ends, ahead = project(corners)
    boxes = np.argsort(-ahead.mean(axis=1))
    limits = [np.inf, *ahead.mean(axis=1)[boxes], NEAR]
    for layer, (far, near) in enumerate(pairwise(limits)):
        draw_points(order[(depth[order] <= far) & (depth[order] > near)], 2 * layer)
        if layer < len(boxes):
            k = boxes[layer]
            axes.add_collection(PolyCollection(
                [ends[k][face] for face in FACES], zorder=2 * layer + 1,
                facecolors=[(*box_colors[k], 0.07 if i else 0.38) for i in range(len(FACES))]))
            axes.add_collection(LineCollection(ends[k][EDGES], colors=[box_colors[k]],
                                               linewidths=1.1, zorder=2 * len(limits)))
    for i, (name, color) in enumerate(CLASS_COLORS.items()):
        figure.text(0.985, 0.955 - i * 0.05, name, ha="right", va="center", fontsize=15,
                    color=color)
    figure.savefig(path)


def make(path: Path = PICTURE) -> None:
    """Simulate the scan, run the package on it, write the picture."""
    frame = scan_at(SEED, 0, HDL64E, STREETS).frame
    params = DetectorParams()
    ground = segment_ground(frame, params.ground)
    cluster_ids = np.zeros(len(frame), np.int32)
    cluster_ids[~ground] = cluster(frame.xyz[~ground], params.clustering)
    draw_scene(path, frame, ground, cluster_ids, open_detector()(frame).detections)


if __name__ == "__main__":
    make(*map(Path, sys.argv[1:]))

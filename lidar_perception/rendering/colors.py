"""Colours of points and boxes on a dark background."""

from __future__ import annotations

import numpy as np

from lidar_perception.classes import DETECTED
from lidar_perception.types import CLASSES
from msg_utils.markers import COLORS, OTHER_COLOR

BACKGROUND = np.array([11, 15, 24], np.uint8)
LABEL = (235, 240, 245)  # colour of labelled boxes, which are dashed
TEXT, DIM = (225, 230, 238), (130, 142, 160)
GRID = (38, 47, 64)
# Colours of the detected classes. Other classes have the colours of their markers at full brightness.
DETECTED_COLORS = dict(zip(DETECTED, ((64, 186, 255), (255, 104, 80), (255, 212, 66))))
# Heights above the ground in metres of HEIGHT_COLORS, which are dull at the ground and light at roof height.
HEIGHTS = (-0.3, 0.15, 0.9, 1.8, 3.5, 7.0)
HEIGHT_COLORS = np.array(
    [[46, 66, 106], [70, 96, 142], [76, 140, 166], [126, 190, 184], [206, 216, 190], [224, 200, 210]], np.float32
)
GROUND_COLOR, UNCLUSTERED_COLOR = np.array([[92, 120, 158], [140, 153, 173]], np.uint8)
CLUSTER_COLORS = np.array(
    [  # these colours are muted, so that boxes stand out
        [143, 120, 219],
        [84, 166, 158],
        [209, 143, 168],
        [128, 173, 97],
        [97, 143, 217],
        [204, 166, 107],
        [173, 107, 173],
        [107, 179, 204],
        [194, 128, 112],
        [148, 158, 117],
    ],
    np.uint8,
)
INTENSITIES = (0.0, 0.15, 0.4, 1.0)
INTENSITY_COLORS = np.array([[38, 52, 84], [74, 104, 150], [140, 180, 190], [250, 246, 220]], np.float32)


def color_by_height(heights: np.ndarray) -> np.ndarray:
    """Return colours (N, 3) uint8 for points at heights (N,) in metres above the ground."""
    return _interpolate(heights, HEIGHTS, HEIGHT_COLORS)


def color_by_intensity(intensity: np.ndarray) -> np.ndarray:
    """Return colours (N, 3) uint8 for intensities (N,), 0..1."""
    return _interpolate(intensity, INTENSITIES, INTENSITY_COLORS)


def color_by_cluster(ground: np.ndarray, cluster_ids: np.ndarray) -> np.ndarray:
    """Return colours (N, 3) uint8 for points of the ground and of clusters.

    Consecutive cluster ids have different colours.

    Args:
        ground: (N,) bool mask of the ground points.
        cluster_ids: (N,) int cluster of each point, 0 for none.
    """
    colors = np.where(ground[:, None], GROUND_COLOR, UNCLUSTERED_COLOR)
    in_cluster = (cluster_ids > 0) & ~ground
    colors[in_cluster] = CLUSTER_COLORS[cluster_ids[in_cluster] * 7 % len(CLUSTER_COLORS)]
    return colors


def _interpolate(values: np.ndarray, stops: tuple[float, ...], colors: np.ndarray) -> np.ndarray:
    """Interpolate between the colours (S, 3) at S stops, with a lookup table of 256 colours."""
    steps = np.linspace(stops[0], stops[-1], 256)
    table = np.stack([np.interp(steps, stops, colors[:, c]) for c in range(3)], axis=1)
    position = (np.asarray(values, np.float32) - stops[0]) / (stops[-1] - stops[0])
    return table.astype(np.uint8)[np.clip(position * 255, 0, 255).astype(np.uint8)]


def get_class_color(class_id: int) -> tuple[int, int, int]:
    """Return the colour r g b of a class, 0..255."""
    name = CLASSES[class_id]
    if name in DETECTED_COLORS:
        return DETECTED_COLORS[name]
    color = np.array(COLORS.get(name, OTHER_COLOR))
    r, g, b = np.round(255 * color / color.max()).astype(int).tolist()
    return r, g, b

"""Scene objects, and the distribution of the sizes of labelled ones."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

# Length, width, height in metres: mean, standard deviation, and correlation of length and height
# of the labels in 57 frames of KITTI's object training set and 30 frames of tracking sequence 0000
# (207 cars, 18 vans, 5 trucks, 4 trams, 15 pedestrians, 13 cyclists). These frames contain no sitting
# people, so their mean is that of the full training set, and their deviation is a guess.
SIZES = {
    "Car": ((3.88, 1.62, 1.51), (0.47, 0.11, 0.11), 0.0),
    "Van": ((4.68, 1.83, 1.96), (0.59, 0.16, 0.19), 0.8),
    "Truck": ((11.2, 2.50, 3.26), (2.4, 0.09, 0.23), 0.0),
    "Tram": ((14.2, 2.52, 3.64), (1.3, 0.21, 0.14), 0.0),
    "Pedestrian": ((0.85, 0.60, 1.76), (0.19, 0.10, 0.10), 0.1),
    "Person_sitting": ((0.80, 0.60, 1.28), (0.08, 0.06, 0.06), 0.0),
    "Cyclist": ((1.81, 0.66, 1.72), (0.17, 0.13, 0.09), 0.5),
}


class SceneObject(NamedTuple):
    """An object of a scene, with the size of its label.

    Attributes:
        parts: Function that returns the parts (P,) PART after a distance travelled in m. Mirrors
            and pushed objects may extend beyond the box.
        size: Length, width, height in m of the labelled box, which is centred at
            (0, 0, height / 2) in all poses; (0, 0, 0) for an object without a label.
        label: One of CLASSES, "" for an object without a label.
    """

    parts: Callable[[float], np.ndarray]
    size: tuple[float, float, float]
    label: str


def make_rigid(parts: np.ndarray, size: tuple[float, float, float], label: str) -> SceneObject:
    """Return an object with the same parts (P,) PART in all poses."""
    return SceneObject(partial(_return_parts, parts), size, label)


def _return_parts(parts: np.ndarray, distance: float) -> np.ndarray:
    return parts


def draw_size(rng: np.random.Generator, label: str) -> tuple[float, float, float]:
    """Draw length, width and height in m from SIZES, within 2 standard deviations."""
    mean, deviation, correlation = SIZES[label]
    z = rng.normal(size=3)
    z[2] = correlation * z[0] + np.sqrt(1 - correlation**2) * z[2]
    length, width, height = np.asarray(mean) + np.clip(z, -2, 2) * deviation
    return float(length), float(width), float(height)

"""The seed pedestrian: its silhouette and height (paper A, Section 3.5)."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from lidar_perception.candidates.silhouette import (
    COLUMNS,
    ROWS,
    from_pixels,
    silhouettes,
    to_pixels,
)
from lidar_perception.files import write_text
from lidar_perception.geometry import points_in_box
from lidar_perception.types import InputError

MIN_POINTS = 10  # a thinner seed has no shape to compare with; DBSCAN's min_samples likewise


@dataclass(frozen=True)
class Seed:
    """silhouette (80,) uint32, see silhouette.py; height in metres."""

    silhouette: np.ndarray
    height: float


def seed_from_points(xyz: np.ndarray, height: float) -> Seed:
    """Seed of a pedestrian's points (M, 3), M >= 10, and its height above the ground."""
    if len(xyz) < MIN_POINTS:
        raise InputError(f"the seed pedestrian has {len(xyz)} points; pick a nearer one "
                         f"(at least {MIN_POINTS})")
    image = silhouettes(xyz, np.array([0, len(xyz)]), np.ones((1, 1)))[0]
    return Seed(image, float(height))


def seed_from_truth(xyz: np.ndarray, ground: np.ndarray, pedestrians: np.ndarray) -> Seed:
    """Seed of the nearest pedestrian box of (M, 7): its points that are not ground and its
    height. The paper's protocol. InputError where there is no pedestrian or no point on it."""
    if len(pedestrians) == 0:
        raise InputError("no Pedestrian in the ground truth of this frame, so no seed")
    nearest = pedestrians[np.argmin(np.hypot(pedestrians[:, 0], pedestrians[:, 1]))]
    return seed_from_points(xyz[points_in_box(xyz, nearest) & ~ground], nearest[5])


def seed_from_click(click: np.ndarray, xyz: np.ndarray, labels: np.ndarray, boxes: np.ndarray,
                    radius: float) -> Seed:
    """Seed of the cluster whose points (labels 1..K, ground-snapped boxes (K, 7)) come nearest to
    click (3,). InputError where none is within radius."""
    clustered = np.flatnonzero(labels)
    if len(clustered) == 0:
        raise InputError("a point was clicked but the cloud has no clusters")
    distance = np.linalg.norm(xyz[clustered] - np.asarray(click, np.float32), axis=1)
    if distance.min() > radius:
        raise InputError(f"nearest cluster is {distance.min():.1f} m from the clicked point; "
                         f"click within {radius:g} m of a pedestrian")
    label = labels[clustered[distance.argmin()]]
    return seed_from_points(xyz[labels == label], boxes[label - 1, 5])


def save_seed(seed: Seed, path: str | Path) -> None:
    """Write a template as JSON with the silhouette drawn in characters."""
    rows = ["".join(".#"[bit] for bit in row) for row in to_pixels(seed.silhouette).astype(int)]
    write_text(path, json.dumps({"height_m": round(seed.height, 4), "silhouette": rows}, indent=1))


def load_seed(path: str | Path = "") -> Seed:
    """Read a template; an empty path gives the one that comes with the package (a simulated
    pedestrian). InputError names the file and what is wrong with it."""
    source = Path(path) if path else files("lidar_perception.candidates") / "pedestrian.json"
    try:
        content = json.loads(source.read_text())
        pixels = np.array([list(row) for row in content["silhouette"]]) == "#"
        height = float(content["height_m"])
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the template {source}: {error}") from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{source} is not a template ({error!r}); make one with "
                         "'lidar-perception seed'") from None
    if pixels.shape != (ROWS, COLUMNS) or not pixels.any() or not 0 < height < np.inf:
        raise InputError(f"{source}: a template has {ROWS} rows of {COLUMNS} characters with some "
                         "'#', and height_m above 0; make one with 'lidar-perception seed'")
    return Seed(from_pixels(pixels), height)

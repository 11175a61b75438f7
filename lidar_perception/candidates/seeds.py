"""Seed pedestrians and their template files (paper A, Section 3.5)."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.silhouette import draw_silhouettes, to_pixels
from lidar_perception.geometry import points_in_box
from lidar_perception.runs.files import read_text, shorten_error, write_text
from lidar_perception.types import MAX_RANGE, InputError

MIN_POINTS = 10  # minimum number of points with a meaningful shape, equal to DBSCAN's min_samples
DECIMALS = 4  # decimals of coordinates in template files, in metres
MAX_TEMPLATE_BYTES = 10**7  # maximum size of a template file, about 200,000 points


@dataclass(frozen=True)
class Seed:
    """A seed pedestrian.

    Attributes:
        xyz: (M, 3) float32 points in the LiDAR frame, M >= 10.
        floor: z of the ground below the pedestrian, metres.
        height: Body height, metres.
        confidence: Probability that it is a pedestrian, 1 if a user or a label confirms it. None if it is
            unknown or, as for a template, irrelevant.
    """

    xyz: np.ndarray
    floor: float
    height: float
    confidence: float | None = None

    def draw_silhouette(self, params: PipelineParams = PipelineParams()) -> np.ndarray:
        """Draw the silhouette of the seed, (80,) uint32, see silhouette.py."""
        return draw_silhouettes(
            self.xyz, np.array([0, len(self.xyz)]), np.ones((1, 1)), np.array([self.floor]), params
        )[0]


def seed_from_points(xyz: np.ndarray, box: np.ndarray, confidence: float | None = None) -> Seed:
    """Make a seed from a pedestrian's points (M, 3) and its box (7,) on the ground.

    Raises:
        InputError: There are fewer than MIN_POINTS points.
    """
    if len(xyz) < MIN_POINTS:
        raise InputError(
            f"the seed pedestrian has only {len(xyz)} points, but needs at least {MIN_POINTS}; choose a nearer one"
        )
    return Seed(np.ascontiguousarray(xyz, np.float32), float(box[2] - box[5] / 2), float(box[5]), confidence)


def find_seed_cluster(seed: Seed, xyz: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return a mask (K,) bool of the clusters that contain at least half of the seed's points.

    Cluster k has the rows start[k]:start[k + 1] of xyz (N, 3) float32. In frames other than the
    seed's own, the mask is all False.
    """
    row_type = np.dtype((np.void, 12))
    is_seed_point = np.isin(
        np.ascontiguousarray(xyz, np.float32).view(row_type).ravel(),
        np.ascontiguousarray(seed.xyz, np.float32).view(row_type).ravel(),
    )
    shared_counts = np.diff(np.concatenate([[0], np.cumsum(is_seed_point)])[start])
    return 2 * shared_counts >= len(seed.xyz)


def seed_from_truth(xyz: np.ndarray, ground: np.ndarray, pedestrians: np.ndarray) -> Seed:
    """Make a seed from the nearest of the labelled pedestrians, as in the paper.

    The seed consists of the points in the box that are not ground, and has the height of the box.

    Args:
        ground: (N,) bool mask of the ground points among xyz (N, 3).
        pedestrians: (M, 7) labelled boxes.

    Raises:
        InputError: There is no pedestrian, or the nearest one has too few points.
    """
    if len(pedestrians) == 0:
        raise InputError("no seed, because the ground truth of this frame has no Pedestrian")
    nearest_pedestrian = pedestrians[np.argmin(np.hypot(pedestrians[:, 0], pedestrians[:, 1]))]
    return seed_from_points(xyz[points_in_box(xyz, nearest_pedestrian) & ~ground], nearest_pedestrian, confidence=1.0)


def seed_from_click(click: np.ndarray, xyz: np.ndarray, labels: np.ndarray, boxes: np.ndarray, radius: float) -> Seed:
    """Make a seed from the cluster nearest to a clicked point, see find_clicked_cluster.

    The boxes (K, 7) of the clusters reach down to the ground.

    Raises:
        InputError: See find_clicked_cluster, or the cluster has too few points.
    """
    label = find_clicked_cluster(click, xyz, labels, radius)
    return seed_from_points(xyz[labels == label], boxes[label - 1], confidence=1.0)


def find_clicked_cluster(click: np.ndarray, xyz: np.ndarray, labels: np.ndarray, radius: float) -> int:
    """Find the cluster nearest to a clicked point and return its label.

    Args:
        click: (3,) point in the frame of the cloud.
        xyz: (N, 3) points.
        labels: (N,) cluster of each point, 0 for none.
        radius: Maximum distance to the cluster, metres.

    Raises:
        InputError: No cluster is within the radius, or the click is not finite.
    """
    click = np.asarray(click, np.float64)
    if not np.isfinite(click).all():
        raise InputError("the coordinates of the clicked point are not finite; click again")
    clustered_indices = np.flatnonzero(labels)
    if len(clustered_indices) == 0:
        raise InputError("no cluster to select with the click, because the cloud has no clusters")
    with np.errstate(over="ignore"):
        distance = np.linalg.norm(xyz[clustered_indices] - click.astype(np.float32), axis=1)
    if not distance.min() <= radius:
        raise InputError(
            f"the nearest cluster is {distance.min():.1f} m from the clicked point; click within {radius:g} m of it"
        )
    return int(labels[clustered_indices[distance.argmin()]])


def save_seed(seed: Seed, path: str | Path) -> None:
    """Write a template as JSON, with its points and its silhouette drawn as text."""
    rows = ["".join(".#"[bit] for bit in row) for row in to_pixels(seed.draw_silhouette()).astype(int)]
    points = [[round(float(value), DECIMALS) for value in point] for point in seed.xyz]
    write_text(
        path,
        json.dumps(
            {
                "height_m": round(seed.height, DECIMALS),
                "floor_m": round(seed.floor, DECIMALS),
                "points_m": points,
                "silhouette": rows,
            },
            indent=1,
        ),
    )


def load_seeds(paths: str = "") -> tuple[Seed, ...]:
    """Read one or more templates from comma-separated paths, see load_seed."""
    return tuple(load_seed(path.strip()) for path in paths.split(","))


def load_seed(path: str | Path = "") -> Seed:
    """Read a template. An empty path selects the shipped template, a simulated pedestrian.

    Raises:
        InputError: The file is not a valid template.
    """
    shipped_file = files("lidar_perception.candidates") / "pedestrian.json"
    source = path or shipped_file
    try:
        content = json.loads(read_text(path, MAX_TEMPLATE_BYTES) if path else shipped_file.read_text())
        with np.errstate(over="ignore"):  # values beyond float32 become inf
            xyz = np.array(content["points_m"], np.float32)
        floor, height = float(content["floor_m"]), float(content["height_m"])
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{source} is not a template file ({shorten_error(error)}); create one with `lidar-perception seed`"
        ) from None
    if (
        xyz.ndim != 2
        or xyz.shape[1] != 3
        or len(xyz) < MIN_POINTS
        or not 0 < height <= MAX_RANGE
        or not (np.abs(xyz) <= MAX_RANGE).all()
        or not abs(floor) <= MAX_RANGE
    ):
        raise InputError(
            f"{source} is not a valid template: expected height_m above 0, and at least {MIN_POINTS} points [x, y, z] "
            "in points_m; create one with `lidar-perception seed`"
        )
    return Seed(xyz, floor, height)

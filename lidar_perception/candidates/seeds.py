"""The seed pedestrian and its template file (paper A, Section 3.5)."""

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

MIN_POINTS = 10  # fewer points have no meaningful shape; equals DBSCAN's min_samples
DECIMALS = 4  # decimals of the coordinates (metres) in a template file
MAX_TEMPLATE_BYTES = 10**7  # maximum size of a template, about 200,000 points


@dataclass(frozen=True)
class Seed:
    """A seed pedestrian.

    xyz (M, 3) float32 are its points in the LiDAR frame, M >= 10; floor is z of the ground under
    it, and height its own height above that, in metres. certain: a person or a label confirms that
    it is a pedestrian.
    """

    xyz: np.ndarray
    floor: float
    height: float
    certain: bool = False

    def silhouette(self, params: PipelineParams = PipelineParams()) -> np.ndarray:
        """Draw the seed's silhouette, (80,) uint32 (see silhouette.py)."""
        return draw_silhouettes(
            self.xyz, np.array([0, len(self.xyz)]), np.ones((1, 1)), np.array([self.floor]), params
        )[0]


def seed_from_points(xyz: np.ndarray, box: np.ndarray, certain: bool = False) -> Seed:
    """Make a seed of a pedestrian's points (M, 3), M >= 10, and its box (7,) on the ground."""
    if len(xyz) < MIN_POINTS:
        raise InputError(f"the seed pedestrian has {len(xyz)} points; pick a nearer one (at least {MIN_POINTS})")
    return Seed(np.ascontiguousarray(xyz, np.float32), float(box[2] - box[5] / 2), float(box[5]), certain)


def find_seed_cluster(seed: Seed, xyz: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return (K,) bool: True for a cluster that holds at least half of the seed's own points.

    Cluster k has the rows start[k]:start[k + 1] of xyz (N, 3) float32. All are False in a frame
    other than the seed's.
    """
    row = np.dtype((np.void, 12))
    same = np.isin(
        np.ascontiguousarray(xyz, np.float32).view(row).ravel(),
        np.ascontiguousarray(seed.xyz, np.float32).view(row).ravel(),
    )
    shared = np.diff(np.concatenate([[0], np.cumsum(same)])[start])
    return 2 * shared >= len(seed.xyz)


def seed_from_truth(xyz: np.ndarray, ground: np.ndarray, pedestrians: np.ndarray) -> Seed:
    """Make a seed of the nearest pedestrian of boxes (M, 7), the paper's protocol.

    It has the box's height and the points in the box that are not ground.

    Raises:
        InputError: without a pedestrian, or with too few points on it.
    """
    if len(pedestrians) == 0:
        raise InputError("no Pedestrian in the ground truth of this frame, so no seed")
    nearest = pedestrians[np.argmin(np.hypot(pedestrians[:, 0], pedestrians[:, 1]))]
    return seed_from_points(xyz[points_in_box(xyz, nearest) & ~ground], nearest, certain=True)


def seed_from_click(click: np.ndarray, xyz: np.ndarray, labels: np.ndarray, boxes: np.ndarray, radius: float) -> Seed:
    """Make a seed of the cluster nearest to click (3,).

    Clusters have labels 1..K and ground-snapped boxes (K, 7). Raises InputError as
    find_clicked_cluster does.
    """
    label = find_clicked_cluster(click, xyz, labels, radius)
    return seed_from_points(xyz[labels == label], boxes[label - 1], certain=True)


def find_clicked_cluster(click: np.ndarray, xyz: np.ndarray, labels: np.ndarray, radius: float) -> int:
    """Return the label of the cluster with the point nearest to click (3,).

    labels (N,) are those of points (N, 3), 0 for no cluster.

    Raises:
        InputError: if no cluster is within radius, or the click is not finite.
    """
    click = np.asarray(click, np.float64)
    if not np.isfinite(click).all():
        raise InputError("the clicked point has a coordinate that is not finite; click again")
    clustered = np.flatnonzero(labels)
    if len(clustered) == 0:
        raise InputError("a point was clicked but the cloud has no clusters")
    with np.errstate(over="ignore"):
        distance = np.linalg.norm(xyz[clustered] - click.astype(np.float32), axis=1)
    if not distance.min() <= radius:
        raise InputError(
            f"nearest cluster is {distance.min():.1f} m from the clicked point; click within {radius:g} m of one"
        )
    return int(labels[clustered[distance.argmin()]])


def save_seed(seed: Seed, path: str | Path) -> None:
    """Write a template as JSON: the points, and the silhouette as text for readers."""
    rows = ["".join(".#"[bit] for bit in row) for row in to_pixels(seed.silhouette()).astype(int)]
    points = [[round(float(v), DECIMALS) for v in p] for p in seed.xyz]
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
    """Read one or more templates, with commas between their paths, as load_seed() does."""
    return tuple(load_seed(path.strip()) for path in paths.split(","))


def load_seed(path: str | Path = "") -> Seed:
    """Read a template; an empty path reads the package's own, a simulated pedestrian.

    Raises:
        InputError: naming the file and the error in it.
    """
    packaged = files("lidar_perception.candidates") / "pedestrian.json"
    source = path or packaged
    try:
        content = json.loads(read_text(path, MAX_TEMPLATE_BYTES) if path else packaged.read_text())
        with np.errstate(over="ignore"):  # values beyond float32 become inf
            xyz = np.array(content["points_m"], np.float32)
        floor, height = float(content["floor_m"]), float(content["height_m"])
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{source} is not a template ({shorten_error(error)}); make one with 'lidar-perception seed'"
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
            f"{source}: a template has {MIN_POINTS} points_m or more of x, y, z, and "
            "height_m above 0; make one with 'lidar-perception seed'"
        )
    return Seed(xyz, floor, height)

"""Statistics of a scan and its labelled objects, by range, angle or quantile.

Each scan or object adds one row (B,) to a curve, with one value per bin; NaN if there is no sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from experiments.realism.roughness import compute_roughness
from lidar_perception.camera import Camera
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import segment_cloud
from lidar_perception.candidates.refine import STAGES, select_by_height
from lidar_perception.classes import CAR, DETECTED
from lidar_perception.geometry import box_corners, horizontal_range, points_in_box, to_box_frame
from lidar_perception.ground.params import GroundParams
from lidar_perception.ground.segment import segment_ground
from lidar_perception.scoring.centres.matching import RANGE_NAMES
from lidar_perception.types import GroundTruth, PointCloud

CLASSES = tuple(DETECTED)
PERSON_HEIGHT = 1.7  # seed height in metres for the height filter in stage 1 of the STM-CPA paper
SECTORS = 36  # number of sectors of a revolution
MIN_SECTORS = 27  # a scan with points in fewer sectors is cropped to the camera's view
MIN_POINTS = 5  # minimum number of points to measure an object's extent or intensity
MIN_BIN_POINTS = 50  # minimum number of points in a range bin to measure its ground fraction
MAX_QUERIES, MIN_QUERIES = 600, 10  # number of points in a range bin whose neighbours are measured
RANGES = np.array([0.0, 5, 10, 15, 20, 30, 40, 60, 80, np.inf])
OBJECT_RANGES = np.array([0.0, 10, 20, 30, 45, 60])
ELEVATIONS = np.arange(-26.0, 4.1, 2.0)
QUANTILES = (5, 25, 50, 75, 95)
INTENSITY_STEP = 0.01
ROUGH_STEP_M = 0.002  # smaller differences in roughness are ignored
BELT_HEIGHT = 0.65  # height of the lower edge of a car's windows, as a fraction of its height
CAR_NAME = CLASSES[CAR]
CAR_FROM = f"{CAR_NAME} from "
# Directions from which a sensor sees only one face of a car, in degrees from its front.
FACES = {"behind": (160.0, 180.0), "the side": (45.0, 135.0), "the front": (0.0, 20.0)}
MIN_FACE_POINTS, FACE_QUANTILES, FACE_STEP_M = 20, (10, 25, 50), 0.01
SCORES = {"precision": ("tp", "fp"), "recall": ("tp", "fn"), "f1": ("tp", "fp", "fn")}


def _name_bins(limits: np.ndarray) -> tuple[str, ...]:
    return tuple(f"{a:g}+" if math.isinf(b) else f"{a:g}-{b:g}" for a, b in pairwise(limits))


@dataclass(frozen=True)
class Curve:
    """A quantity measured in bins.

    Attributes:
        title: Name of the quantity, with its unit.
        bins: Names of the bins.
        axis: Label of the axis of the bins.
        step: Resolution. Smaller differences are ignored.
    """

    title: str
    bins: tuple[str, ...]
    axis: str = "range [m]"
    step: float = 0.0


_BY_RANGE, _BY_OBJECT_RANGE = _name_bins(RANGES), _name_bins(OBJECT_RANGES)
_BY_QUANTILE = tuple(f"{q}%" for q in QUANTILES)
_SURFACES = ("ground", "above ground", *CLASSES)
CURVES = {
    "scan points": Curve("points per scan", ("all",), ""),
    "points": Curve("points", _BY_RANGE),
    "elevation": Curve("points", tuple(f"{a:g}..{a + 2:g}" for a in ELEVATIONS[:-1]), "elevation [deg]"),
    "ground share": Curve("fraction of points on the ground", _BY_RANGE),
    "roughness": Curve("scatter about the ground of 1 m2, 75 % [m]", _BY_RANGE, step=ROUGH_STEP_M),
    "neighbour": Curve("distance to the nearest point [m]", _BY_RANGE),
    "clusters": Curve("clusters", _BY_RANGE),
    "person clusters": Curve("clusters as high as a person", _BY_RANGE),
    **{f"{name} density": Curve(f"{name}: points per square degree", _BY_OBJECT_RANGE) for name in CLASSES},
    **{
        f"{surface} intensity": Curve(f"intensity, {surface}", _BY_QUANTILE, "quantile", step=INTENSITY_STEP)
        for surface in _SURFACES
    },
    **{
        f"{name} {quantity}": Curve(f"{name}: {title}", _BY_OBJECT_RANGE)
        for name in CLASSES
        for quantity, title in (
            ("points", "points, not occluded"),
            ("points of all", "points, all"),
            ("height", "height seen / box"),
            ("length", "length seen / box"),
            ("width", "width seen / box"),
            ("above", "points above 0.65 of the height"),
        )
    },
    **{
        CAR_FROM + face: Curve(
            f"{CAR_FROM}{face}: depth of the points in the box [m]",
            tuple(f"{q}%" for q in FACE_QUANTILES),
            "quantile",
            step=FACE_STEP_M,
        )
        for face in FACES
    },
    **{
        f"{stage} {score}": Curve(f"paper A, {stage}: {score}", (*RANGE_NAMES, "all"))
        for stage in STAGES
        for score in SCORES
    },
}


def is_full_scan(frame: PointCloud) -> bool:
    """Return True if there are points all around the sensor, not only in a camera's view."""
    revolution = np.arctan2(frame.xyz[:, 1], frame.xyz[:, 0]) / (2 * np.pi) + 0.5
    return len(np.unique((revolution * SECTORS).astype(int) % SECTORS)) >= MIN_SECTORS


def compute_scan_rows(frame: PointCloud, params: PipelineParams = PipelineParams()) -> dict:
    """Return the row (1, B) of each curve for one full scan.

    The ground is segmented with the cloth method, the clusters with `params`.
    """
    xyz, bins = frame.xyz, len(RANGES) - 1
    ranges = horizontal_range(xyz)
    point_bins, elevation = _find_bins(ranges, RANGES), np.degrees(np.arctan2(xyz[:, 2], ranges))
    counts = np.bincount(point_bins, minlength=bins)
    ground = segment_ground(frame, GroundParams(method="cloth"))
    ground_counts = np.bincount(point_bins.compress(ground), minlength=bins)
    boxes = segment_cloud(frame, params=params).boxes
    box_bins = _find_bins(horizontal_range(boxes), RANGES)
    is_person_height = select_by_height(boxes, PERSON_HEIGHT, params.height)
    rows = {
        "scan points": [len(xyz)],
        "points": counts,
        "elevation": np.histogram(elevation, ELEVATIONS)[0],
        "ground share": np.where(counts >= MIN_BIN_POINTS, ground_counts / np.maximum(counts, 1), np.nan),
        "roughness": compute_roughness(xyz, RANGES),
        "neighbour": _measure_neighbours(xyz, point_bins),
        "clusters": np.bincount(box_bins, minlength=bins),
        "person clusters": np.bincount(box_bins[is_person_height], minlength=bins),
    }
    if frame.intensity is not None:
        for name, mask in (("ground", ground), ("above ground", ~ground)):
            rows.update(_describe_intensity(name, frame.intensity.compress(mask)))
    return {curve: np.atleast_2d(np.asarray(row, float)) for curve, row in rows.items()}


def compute_object_rows(frame: PointCloud, truth: GroundTruth, camera: Camera | None) -> dict:
    """Return the rows (K, B) of each curve for labelled objects with at least one point.

    With a camera, only objects that are completely in its view are measured, because KITTI's labels
    and cropped scans contain only parts of other objects. Objects labelled as occluded are measured
    only for `points of all` and intensity.
    """
    rows: dict[str, list] = {}
    bins = len(_BY_OBJECT_RANGE)
    for i, (box, name) in enumerate(zip(truth.boxes, truth.labels)):
        bin_index = _find_bins(horizontal_range(box[None]), OBJECT_RANGES)[0]
        if name not in CLASSES or bin_index == bins or not _is_in_view(camera, box):
            continue
        indices = np.flatnonzero(points_in_box(frame.xyz, box))
        if len(indices) == 0:
            continue
        values: dict[str, float] = {"points of all": len(indices)}
        if truth.extras[i].get("occluded", 0) == 0:
            values |= {"points": len(indices), "density": len(indices) / compute_square_degrees(box)}
            if len(indices) >= MIN_POINTS:
                relative_points = to_box_frame(frame.xyz[indices].astype(float), box) / box[3:6]
                values |= dict(zip(("length", "width", "height"), np.ptp(relative_points, axis=0)))
                values["above"] = (relative_points[:, 2] > BELT_HEIGHT - 0.5).mean()
        object_rows = {
            f"{name} {quantity}": np.where(np.arange(bins) == bin_index, value, np.nan)
            for quantity, value in values.items()
        }
        if frame.intensity is not None and len(indices) >= MIN_POINTS:
            object_rows |= _describe_intensity(name, frame.intensity[indices])
        if name == CAR_NAME and truth.extras[i].get("occluded", 0) == 0:
            object_rows |= _measure_depths(frame.xyz[indices].astype(float), box)
        for curve, row in object_rows.items():
            rows.setdefault(curve, []).append(row)
    return {curve: np.array(values) for curve, values in rows.items()}


def _measure_depths(xyz: np.ndarray, box: np.ndarray) -> dict:
    """Return quantiles of the distance between points (N, 3) of a car and the visible face of its box.

    Empty if two faces are visible, or if there are too few points.
    """
    if len(xyz) < MIN_FACE_POINTS:
        return {}
    sensor, relative_points = to_box_frame(np.zeros((1, 3)), box)[0], to_box_frame(xyz, box)
    angle = abs(np.degrees(np.arctan2(sensor[1], sensor[0])))
    for face, (low, high) in FACES.items():
        if low <= angle <= high:
            axis = int(face == "the side")
            depth = box[3 + axis] / 2 - np.sign(sensor[axis]) * relative_points[:, axis]
            return {CAR_FROM + face: np.quantile(depth, np.array(FACE_QUANTILES) / 100)}
    return {}


def compute_square_degrees(box: np.ndarray) -> float:
    """Return the solid angle in square degrees that a box (7,) covers, seen as an upright rectangle."""
    distance = np.hypot(box[0], box[1])
    relative_yaw = box[6] - np.arctan2(box[1], box[0])
    width = box[3] * abs(np.sin(relative_yaw)) + box[4] * abs(np.cos(relative_yaw))
    return float(np.prod(np.degrees(2 * np.arctan2([width / 2, box[5] / 2], distance))))


def _is_in_view(camera: Camera | None, box: np.ndarray) -> bool:
    """Return True if the box is completely in the camera's view, or if there is no camera."""
    return camera is None or bool(camera.in_view(box_corners(box[None])[0]).all())


def _find_bins(values: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Return the index of the bin of each value (N,), or len(limits) - 1 beyond the last bin."""
    return np.searchsorted(limits, values, side="right") - 1


def _measure_neighbours(xyz: np.ndarray, point_bins: np.ndarray) -> np.ndarray:
    """Return the median distance to the nearest point in each range bin, measured at evenly spaced points."""
    row = np.full(len(RANGES) - 1, np.nan)
    tree = cKDTree(xyz)
    for i in range(len(row)):
        members = np.flatnonzero(point_bins == i)
        positions = np.linspace(0, len(members) - 1, min(len(members), MAX_QUERIES))
        queries = members[positions.astype(int)]
        if len(queries) >= MIN_QUERIES:
            row[i] = np.median(tree.query(xyz[queries], k=2)[0][:, 1])
    return row


def _describe_intensity(name: str, values: np.ndarray) -> dict:
    """Return the quantiles of intensities (N,)."""
    return {f"{name} intensity": np.quantile(values, np.array(QUANTILES) / 100)} if len(values) else {}

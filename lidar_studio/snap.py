"""Fitting of boxes to clusters, to the ground and to a given size."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar_perception.candidates.params import SeedParams
from lidar_perception.candidates.seeds import find_clicked_cluster
from lidar_perception.classes import DETECTED, Size
from lidar_perception.clustering.shapes import fit_boxes
from lidar_perception.geometry import points_in_box, to_box_frame, wrap_angle
from lidar_perception.ground.surface import fit_ground_surface
from lidar_perception.types import InputError
from lidar_studio.actions import Action, require_box, require_frame, require_track
from lidar_studio.drive import Drive, Scan
from lidar_studio.state import KEY, State

Array = np.ndarray[Any, Any]
BOX_MARGIN_M = 0.3  # margin around a box when searching for its cluster
# The ground height is fitted to ground points within this distance, if there are enough of them.
MIN_GROUND_POINTS, MAX_GROUND_DISTANCE_M = 20, 15.0
MIN_PART_FRACTION = 0.2  # smaller clusters in a box, relative to the largest one, belong to other objects
# A cluster is part of a clicked vehicle if this fraction of its points is close to the click: within the usual
# length times this ratio.
MIN_INSIDE_FRACTION, PART_RADIUS_RATIO = 0.8, 0.55
MIN_RADIUS_M = 0.1  # the radius around the click reaches at least this far beyond the nearest point of the cluster
MAX_LENGTH_RATIO = 1.5  # a cluster that exceeds the usual length by this ratio contains other objects
LONG_OBJECT_M = 2.5  # the far side of objects with a larger usual length is hidden
MAX_END_RATIO = 1.3  # a cluster not longer than the usual width times this ratio is the front or rear of a vehicle


def fit_clicked_box(scan: Scan, click: Array, class_name: str) -> Array:
    """Fit a box (7,) to the cluster at the clicked point (3,).

    The box stands on the ground and is at least as large as is usual for the class.

    Raises:
        InputError: There is no cluster near the point.
    """
    cluster_id = find_clicked_cluster(click, scan.xyz, scan.cluster_ids, SeedParams().click_radius)
    is_member = scan.cluster_ids == cluster_id
    usual_size = find_usual_size(class_name)
    distances = np.hypot(*(scan.xyz[:, :2] - click[:2]).T)
    if usual_size is not None and usual_size[0] > LONG_OBJECT_M:  # long objects are often split into several clusters
        is_near = distances < usual_size[0] * PART_RADIUS_RATIO
        near_counts, point_counts = (
            np.bincount(scan.cluster_ids[mask], minlength=scan.cluster_ids.max() + 1) for mask in (is_near, slice(None))
        )
        is_part = (near_counts > MIN_INSIDE_FRACTION * point_counts) & (np.arange(len(point_counts)) > 0)
        is_member |= is_part[scan.cluster_ids]
    box = _fit_box(scan, is_member)
    if usual_size is not None and box[3] > MAX_LENGTH_RATIO * usual_size[0]:  # the cluster includes other objects
        # The radius must reach the cluster, even if the click was not on it.
        radius = max(usual_size[0] * PART_RADIUS_RATIO, distances[is_member].min() + MIN_RADIUS_M)
        box = _fit_box(scan, is_member & (distances < radius))
    return complete_box(box, usual_size)


def snap_to_cluster(scan: Scan, box: Array) -> Array:
    """Fit an L-shape (7,) to the cluster in a box (7,), with the heading kept within 45 degrees.

    Raises InputError if there is no cluster in the box.
    """
    is_inside = points_in_box(scan.xyz, box, BOX_MARGIN_M) & (scan.cluster_ids > 0)
    counts = np.bincount(scan.cluster_ids[is_inside], minlength=scan.cluster_ids.max(initial=0) + 1)
    if not counts.any():
        raise InputError("no cluster in the box; move the box onto a cluster")
    is_large = counts >= MIN_PART_FRACTION * counts.max()
    return align_heading(_fit_box(scan, is_inside & is_large[scan.cluster_ids]), box[6])


def snap_to_ground(scan: Scan, box: Array) -> Array:
    """Move a box (7,) vertically onto the ground. Raises InputError if no ground is visible around it."""
    ground_height = _estimate_ground_height(scan, box)
    if not np.isfinite(ground_height):
        raise InputError("no ground points around the box; move the box manually")
    return np.array([*box[:2], ground_height + box[5] / 2, *box[3:]])


def _estimate_ground_height(scan: Scan, box: Array) -> float:
    """Estimate the z of the ground below a box (7,), NaN if there are too few ground points around it."""
    ground = scan.xyz[scan.ground]
    ground = ground[np.hypot(*(ground[:, :2] - box[:2]).T) < MAX_GROUND_DISTANCE_M]
    if len(ground) < MIN_GROUND_POINTS:
        return np.nan
    return float(fit_ground_surface(ground, float(np.median(ground[:, 2]))).height_at(box[None])[0])


def resize_box(box: Array, size: Array) -> Array:
    """Resize a box (7,) to length, width and height (3,).

    The bottom and the corner nearest to the sensor stay in place.
    """
    cos, sin = np.cos(box[6]), np.sin(box[6])
    sensor = to_box_frame(np.zeros((1, 3)), box)[0, :2]
    growth_directions = -np.where(np.abs(sensor) > box[3:5] / 2, np.sign(sensor), 0.0)
    shift_x, shift_y = growth_directions * (size[:2] - box[3:5]) / 2  # along the axes of the box
    return np.array(
        [
            box[0] + cos * shift_x - sin * shift_y,
            box[1] + sin * shift_x + cos * shift_y,
            box[2] + (size[2] - box[5]) / 2,
            *size,
            box[6],
        ]
    )


def align_heading(box: Array, yaw: float) -> Array:
    """Rotate the heading of a box (7,) towards a yaw by a multiple of 90 degrees.

    Length and width are swapped if necessary, so that the box covers the same volume.
    """
    quarter_turns = round(float(wrap_angle(yaw - box[6])) / (np.pi / 2))
    sides = box[3:5] if quarter_turns % 2 == 0 else box[[4, 3]]
    return np.array([*box[:3], *sides, box[5], wrap_angle(box[6] + quarter_turns * np.pi / 2)])


def find_usual_size(class_name: str) -> Size | None:
    """Return the mean size of a class, or None if it is not one of the DETECTED classes."""
    return DETECTED[class_name].mean_size if class_name in DETECTED else None


def complete_box(box: Array, usual_size: Size | None) -> Array:
    """Enlarge the box (7,) of the visible points to the usual size of the class.

    Boxes of people grow evenly; boxes of vehicles grow away from the sensor. If the length of a vehicle
    is less than MAX_END_RATIO times the usual width, only its front or rear is visible.
    """
    if usual_size is None:
        return box
    length, width, height = usual_size
    is_vehicle = length > LONG_OBJECT_M
    if is_vehicle and box[3] < MAX_END_RATIO * width:
        box = align_heading(box, box[6] + np.pi / 2)
    size = np.array([max(box[3], length), max(box[4], width), box[5] if box[5] > height / 2 else height])
    if is_vehicle:
        return resize_box(box, size)
    return np.array([*box[:2], box[2] + (size[2] - box[5]) / 2, *size, box[6]])


def _fit_box(scan: Scan, is_member: Array) -> Array:
    """Fit an L-shape (7,) to the selected points (N,) bool, extended down to the ground."""
    xyz = scan.xyz[is_member]
    box = fit_boxes(xyz, np.ones(len(xyz), np.int32), "l_shape")[0].astype(np.float64)
    ground_height = _estimate_ground_height(scan, box)
    if np.isfinite(ground_height):
        top = max(box[2] + box[5] / 2, ground_height + 0.1)
        box[2], box[5] = (ground_height + top) / 2, top - ground_height
    box[3:6] = np.maximum(box[3:6], 0.05)
    return box


def snap_box(action: Action, state: State, drive: Drive) -> Array:
    """Compute the box of a "snap" action: fitted to its cluster, moved onto the ground, or resized.

    Raises:
        InputError: There is no such track, frame or box, or the target is unknown.
    """
    track = require_track(state, action.get("track"))
    frame = require_frame(action, drive.motion)
    box = np.array(require_box(track, frame).values)
    if action.get("to") == "size":
        other_sizes = [b.values[3:6] for f, b in track.boxes.items() if f != frame]
        key_sizes = [b.values[3:6] for f, b in track.boxes.items() if f != frame and b.kind == KEY]
        return resize_box(box, np.median(key_sizes or other_sizes or [tuple(box[3:6])], axis=0))
    if action.get("to") not in ("cluster", "ground"):
        raise InputError(f"unknown snap target {str(action.get('to'))[:40]!r}; choose from cluster, ground, size")
    scan = drive.load_scan(frame)
    return snap_to_cluster(scan, box) if action["to"] == "cluster" else snap_to_ground(scan, box)

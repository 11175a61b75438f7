"""Fitting of boxes to points: to a cluster, to the ground, to a given size."""

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
# Without ground points below a box, this many of the nearest ones are used, up to this distance.
MIN_GROUND_POINTS, MAX_GROUND_DISTANCE_M = 20, 15.0
MIN_PIECE_SHARE = 0.2  # min size relative to the largest cluster in a box; smaller ones are other objects
# A cluster is part of a clicked vehicle if this fraction of its points is within this fraction of the
# usual length from the click.
MIN_INSIDE_SHARE, PIECE_RADIUS_RATIO = 0.8, 0.55
MIN_RADIUS_M = 0.1  # minimum reach beyond the cluster point nearest to the click
MAX_LENGTH_RATIO = 1.5  # max ratio to the usual length; a longer cluster contains other objects
LONG_OBJECT_M = 2.5  # usual length of objects whose far side is hidden
MAX_END_RATIO = 1.3  # max ratio to the usual width; a shorter side is the front or the rear


def fit_clicked_box(scan: Scan, click: Array, class_name: str) -> Array:
    """Fit a box (7,) to the cluster at a point (3,): on the ground, at least of the class's usual
    size. InputError if there is no cluster near the point."""
    label = find_clicked_cluster(click, scan.xyz, scan.cluster_ids, SeedParams().click_radius)
    members = scan.cluster_ids == label
    usual_size = find_usual_size(class_name)
    if usual_size is not None and usual_size[0] > LONG_OBJECT_M:  # long objects are often split into several clusters
        is_near = np.hypot(*(scan.xyz[:, :2] - click[:2]).T) < usual_size[0] * PIECE_RADIUS_RATIO
        inside, total = (
            np.bincount(scan.cluster_ids[mask], minlength=scan.cluster_ids.max() + 1) for mask in (is_near, slice(None))
        )
        is_part = (inside > MIN_INSIDE_SHARE * total) & (np.arange(len(total)) > 0)
        members |= is_part[scan.cluster_ids]
    box = _fit_box(scan, members)
    if usual_size is not None and box[3] > MAX_LENGTH_RATIO * usual_size[0]:  # the cluster includes other objects
        distances = np.hypot(*(scan.xyz[:, :2] - click[:2]).T)
        # The click may be further from the cluster than the first term.
        radius = max(usual_size[0] * PIECE_RADIUS_RATIO, distances[members].min() + MIN_RADIUS_M)
        box = _fit_box(scan, members & (distances < radius))
    return complete_box(box, usual_size)


def snap_to_cluster(scan: Scan, box: Array) -> Array:
    """Fit an L-shape (7,) to the cluster in a box (7,), keeping the heading within 45 degrees.
    InputError if there is no cluster in the box."""
    inside = points_in_box(scan.xyz, box, BOX_MARGIN_M) & (scan.cluster_ids > 0)
    counts = np.bincount(scan.cluster_ids[inside], minlength=scan.cluster_ids.max(initial=0) + 1)
    if not counts.any():
        raise InputError("there is no cluster in the box; move it onto one")
    is_large = counts >= MIN_PIECE_SHARE * counts.max()
    return align_heading(_fit_box(scan, inside & is_large[scan.cluster_ids]), box[6])


def snap_to_ground(scan: Scan, box: Array) -> Array:
    """Move a box (7,) vertically onto the ground. InputError if no ground is visible there."""
    floor = _find_ground_height(scan, box)
    if not np.isfinite(floor):
        raise InputError("no ground points around the box; move it by hand")
    return np.array([*box[:2], floor + box[5] / 2, *box[3:]])


def _find_ground_height(scan: Scan, box: Array) -> float:
    """Return the z of the ground below a box (7,), NaN without ground points around it."""
    ground = scan.xyz[scan.ground]
    nearby = ground[np.hypot(*(ground[:, :2] - box[:2]).T) < MAX_GROUND_DISTANCE_M]
    if len(nearby) < MIN_GROUND_POINTS:
        return np.nan
    return float(fit_ground_surface(nearby, float(np.median(nearby[:, 2]))).height_at(box[None])[0])


def resize_box(box: Array, size: Array) -> Array:
    """Resize a box (7,) to length, width and height (3,); the bottom and the corner nearest to the
    sensor stay in place."""
    cos, sin = np.cos(box[6]), np.sin(box[6])
    sensor = to_box_frame(np.zeros((1, 3)), box)[0, :2]
    away = -np.where(np.abs(sensor) > box[3:5] / 2, np.sign(sensor), 0.0)
    along, across = away * (size[:2] - box[3:5]) / 2
    return np.array(
        [
            box[0] + cos * along - sin * across,
            box[1] + sin * along + cos * across,
            box[2] + (size[2] - box[5]) / 2,
            *size,
            box[6],
        ]
    )


def align_heading(box: Array, yaw: float) -> Array:
    """Turn the heading of a box (7,) by a multiple of 90 degrees towards a yaw, and swap its sides
    accordingly, so that it covers the same volume."""
    turns = round(float(wrap_angle(yaw - box[6])) / (np.pi / 2))
    sides = box[3:5] if turns % 2 == 0 else box[[4, 3]]
    return np.array([*box[:3], *sides, box[5], wrap_angle(box[6] + turns * np.pi / 2)])


def find_usual_size(class_name: str) -> Size | None:
    """Return the mean size of a class; None if it is not a detected class."""
    return DETECTED[class_name].mean_size if class_name in DETECTED else None


def complete_box(box: Array, usual_size: Size | None) -> Array:
    """Enlarge the box (7,) of visible points to the usual size of the class.

    Boxes of people grow evenly, those of vehicles away from the sensor. If the length of a vehicle
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


def _fit_box(scan: Scan, members: Array) -> Array:
    """Fit an L-shape (7,) to the selected points (N,) bool, down to the ground."""
    xyz = scan.xyz[members]
    box = fit_boxes(xyz, np.ones(len(xyz), np.int32), "l_shape")[0].astype(np.float64)
    floor = _find_ground_height(scan, box)
    if np.isfinite(floor):
        top = max(box[2] + box[5] / 2, floor + 0.1)
        box[2], box[5] = (floor + top) / 2, top - floor
    box[3:6] = np.maximum(box[3:6], 0.05)
    return box


def snap_box(action: Action, state: State, drive: Drive) -> Array:
    """Return the box of a "snap" action: the track's box moved to its cluster or the ground, or resized.

    Raises:
        InputError: no such track, frame or box, or an unknown target.
    """
    track = require_track(state, action.get("track"))
    frame = require_frame(action, drive.motion)
    box = np.array(require_box(track, frame).values)
    if action.get("to") == "size":
        others = [b.values[3:6] for f, b in track.boxes.items() if f != frame]
        keys = [b.values[3:6] for f, b in track.boxes.items() if f != frame and b.kind == KEY]
        return resize_box(box, np.median(keys or others or [tuple(box[3:6])], axis=0))
    if action.get("to") not in ("cluster", "ground"):
        raise InputError("a box snaps to cluster, ground or size")
    scan = drive.load_scan(frame)
    return snap_to_cluster(scan, box) if action["to"] == "cluster" else snap_to_ground(scan, box)

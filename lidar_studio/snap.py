"""Boxes put right by the points: around the cluster, onto the ground, to a size."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar_perception.candidates.params import SeedParams
from lidar_perception.candidates.seeds import find_clicked_cluster
from lidar_perception.classes import DETECTED, Size
from lidar_perception.clustering.shapes import fit_boxes
from lidar_perception.geometry import points_in_box, to_box_frame, wrap_angle
from lidar_perception.ground.surface import fit_ground_heights
from lidar_perception.types import InputError
from lidar_studio.drive import Scan

Array = np.ndarray[Any, Any]
MARGIN = 0.3       # metres around a box within which its cluster is looked for
NEAREST, FARTHEST = 20, 15.0  # points of the ground, and metres, where few are near
PIECE = 0.2        # of the points of the largest cluster there: smaller ones are something else
PIECES = 0.55      # of the usual length: so far from a click there are pieces of the same vehicle,
MOST = 0.8         # if more of their points than this are there
BESIDE = 0.1       # metres beyond its nearest point that are taken at least
LARGER = 1.5       # times the usual length: more than the object that was clicked
LONG = 2.5         # metres: what is usually longer hides its far side
WIDER = 1.3        # times the width: a side that is no longer than this is the front or the rear


def around_click(scan: Scan, click: Array, class_name: str) -> Array:
    """(7,) the box of the cluster at a point (3,), on the ground and as large as the class usually
    is. InputError where no cluster is near."""
    label = find_clicked_cluster(click, scan.xyz, scan.cluster_ids, SeedParams().click_radius)
    members = scan.cluster_ids == label
    usual = usual_size(class_name)
    if usual is not None and usual[0] > LONG:  # of which one cluster is often but a piece
        near = np.hypot(*(scan.xyz[:, :2] - click[:2]).T) < usual[0] * PIECES
        inside, whole = (np.bincount(scan.cluster_ids[mask], minlength=scan.cluster_ids.max() + 1)
                         for mask in (near, slice(None)))
        members |= ((inside > MOST * whole) & (np.arange(len(whole)) > 0))[scan.cluster_ids]
    box = _around(scan, members)
    if usual is not None and box[3] > LARGER * usual[0]:  # it has grown together with others
        apart = np.hypot(*(scan.xyz[:, :2] - click[:2]).T)
        reach = max(usual[0] * PIECES, apart[members].min() + BESIDE)  # also of a click beside it
        box = _around(scan, members & (apart < reach))
    return completed(box, usual)


def to_cluster(scan: Scan, box: Array) -> Array:
    """(7,) the L-shape of the cluster in a box (7,), headed as that is. InputError where no cluster
    is in it."""
    near = points_in_box(scan.xyz, box, MARGIN) & (scan.cluster_ids > 0)
    counts = np.bincount(scan.cluster_ids[near], minlength=scan.cluster_ids.max(initial=0) + 1)
    if not counts.any():
        raise InputError("there is no cluster in the box; move it onto one")
    return headed(_around(scan, near & (counts[scan.cluster_ids] >= PIECE * counts.max())), box[6])


def to_ground(scan: Scan, box: Array) -> Array:
    """(7,) the box with its bottom on the ground under it. InputError where none is seen there."""
    floor = _floor(scan, box)
    if not np.isfinite(floor):
        raise InputError("no ground is seen around the box; move it by hand")
    return np.array([*box[:2], floor + box[5] / 2, *box[3:]])


def _floor(scan: Scan, box: Array) -> float:
    """z of the ground under a box (7,), or of the nearest ground where few of its points are seen;
    NaN where there is none."""
    ground = scan.xyz[scan.ground]
    floor = float(fit_ground_heights(ground, box[None, :2])[0])
    if np.isfinite(floor) or len(ground) < NEAREST:
        return floor
    apart = np.hypot(*(ground[:, :2] - box[:2]).T)
    nearest = np.argpartition(apart, NEAREST - 1)[:NEAREST]
    return float(np.median(ground[nearest, 2])) if apart[nearest].max() <= FARTHEST else np.nan


def to_size(box: Array, size: Array) -> Array:
    """(7,) the box with another length, width and height; the corner that is nearest to the sensor
    stays where it is, and so does the bottom."""
    cos, sin = np.cos(box[6]), np.sin(box[6])
    seen = to_box_frame(np.zeros((1, 3)), box)[0, :2]
    away = -np.where(np.abs(seen) > box[3:5] / 2, np.sign(seen), 0.0)
    along, across = away * (size[:2] - box[3:5]) / 2
    return np.array([box[0] + cos * along - sin * across, box[1] + sin * along + cos * across,
                     box[2] + (size[2] - box[5]) / 2, *size, box[6]])


def headed(box: Array, yaw: float) -> Array:
    """(7,) the same box, of the four ways to say it that whose yaw is nearest."""
    turns = round(float(wrap_angle(yaw - box[6])) / (np.pi / 2))
    sides = box[3:5] if turns % 2 == 0 else box[[4, 3]]
    return np.array([*box[:3], *sides, box[5], wrap_angle(box[6] + turns * np.pi / 2)])


def usual_size(class_name: str) -> Size | None:
    """Of a class that is detected; None of others."""
    return DETECTED[class_name].mean_size if class_name in DETECTED else None


def completed(box: Array, usual: Size | None) -> Array:
    """(7,) the box of what is seen, made as long and wide as its class usually is. People are seen
    through and through, so theirs grows evenly; others grow away from the sensor, and a side that
    is hardly longer than the width is taken for the width."""
    if usual is None:
        return box
    length, width, height = usual
    vehicle = length > LONG
    if vehicle and box[3] < WIDER * width:
        box = headed(box, box[6] + np.pi / 2)
    size = np.array([max(box[3], length), max(box[4], width),
                     box[5] if box[5] > height / 2 else height])
    if vehicle:
        return to_size(box, size)
    return np.array([*box[:2], box[2] + (size[2] - box[5]) / 2, *size, box[6]])


def _around(scan: Scan, members: Array) -> Array:
    """(7,) the L-shape around points (N,) bool, down to the ground."""
    xyz = scan.xyz[members]
    box = fit_boxes(xyz, np.ones(len(xyz), np.int32), "l_shape")[0].astype(np.float64)
    floor = _floor(scan, box)
    if np.isfinite(floor):
        top = max(box[2] + box[5] / 2, floor + 0.1)
        box[2], box[5] = (floor + top) / 2, top - floor
    box[3:6] = np.maximum(box[3:6], 0.05)
    return box

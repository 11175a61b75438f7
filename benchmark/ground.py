"""Comparison of our ground segmentation with its peers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from benchmark import peers
from benchmark.rows import compute_speedup, make_measurement, make_row
from benchmark.timing import SLOW_REPEAT, Clock, thin_cloud
from lidar_perception.data.frame import Frame
from lidar_perception.ground.cloth import segment_by_cloth
from lidar_perception.ground.params import ClothParams, GroundParams
from lidar_perception.ground.patchwork import segment_by_patchwork
from lidar_perception.ground.segment import METHODS
from lidar_perception.ground.threshold import segment_by_threshold
from lidar_perception.runs.terminal import show_progress
from lidar_perception.scoring.points.segmentation import PROTOCOLS, GroundReport, count_by_protocol
from lidar_perception.types import SENSOR_HEIGHT, PointCloud

PARAMS = GroundParams()
MAX_Z = PARAMS.threshold.max_height - SENSOR_HEIGHT  # both implementations fit a plane to the points below this


def measure_threshold(title: str, clouds: list[np.ndarray], repeat: int) -> dict:
    """Measure our plane fit and scikit-learn's RANSAC on the low points of clouds (N, 3), as in paper A."""
    peer, points = peers.RANSAC, np.median([len(c) for c in clouds])
    if peer.find_problem():
        return make_measurement(title, len(clouds), points, [make_row(peer.name, note=peer.find_problem())])

    def make_calls(xyz):
        # The time includes the selection of the low points, like ours.
        return {peer.name: lambda: peer.run(xyz, xyz[:, 2] < MAX_Z), "ours": partial(segment_by_threshold, xyz)}

    clock = Clock(repeat, make_calls(thin_cloud(clouds[0])))
    for xyz in show_progress(clouds, title, len(clouds)):
        clock.time(make_calls(xyz))
    return make_measurement(title, len(clouds), points, [compute_speedup(peer.name, clock.compute_medians(), 3)])


def measure_patchwork(frames: list[PointCloud], repeat: int) -> dict:
    """Measure our Patchwork++ and the library, which gets a ready array and uses a new object per cloud."""
    title, name = "Patchwork++, full scan", peers.PATCHWORK.name
    points = np.median([len(f) for f in frames])
    if peers.PATCHWORK.find_problem():
        return make_measurement(title, len(frames), points, [make_row(name, note=peers.PATCHWORK.find_problem())])

    def make_calls(frame, cloud):
        return {
            name: partial(peers.PATCHWORK.run, cloud, SENSOR_HEIGHT),
            "ours": partial(segment_by_patchwork, frame.xyz, frame.intensity, SENSOR_HEIGHT),
        }

    same_count = differ_count = 0
    with peers.silence_stdout():
        clock = Clock(repeat, make_calls(frames[0], frames[0].points()))
        for frame in show_progress(frames, title, len(frames)):
            masks = clock.time(make_calls(frame, frame.points()))
            difference = int((_to_mask(masks[name], len(frame)) != masks["ours"]).sum())
            same_count, differ_count = same_count + (difference == 0), differ_count + difference
    return make_measurement(
        title, len(frames), points, [compute_speedup(name, clock.compute_medians(), 1.3, same_count, differ_count)]
    )


def _to_mask(indices, count: int) -> np.ndarray:
    mask = np.zeros(count, bool)
    mask[np.asarray(indices, np.int64)] = True
    return mask


def measure_cloth(scans: list[np.ndarray], repeat: int) -> dict:
    """Measure our cloth and the peer's with the same resolution, on the points within max_range.

    The peer's time does not include the conversions of its input to float64 and of its result to a
    mask.
    """
    title, name = "Cloth, full scan", peers.CLOTH.name
    scans = [_crop_to_max_range(xyz) for xyz in scans]
    points = np.median([len(s) for s in scans])
    if peers.CLOTH.find_problem():
        return make_measurement(title, len(scans), points, [make_row(name, note=peers.CLOTH.find_problem())])

    def make_calls(xyz, xyz_float64):
        return {name: partial(peers.CLOTH.run, xyz_float64), "ours": partial(segment_by_cloth, xyz)}

    with peers.silence_stdout():
        clock = Clock(min(repeat, SLOW_REPEAT), make_calls(*_add_float64(thin_cloud(scans[0]))))
        for xyz in show_progress(scans, title, len(scans)):
            clock.time(make_calls(*_add_float64(xyz)))
    return make_measurement(title, len(scans), points, [compute_speedup(name, clock.compute_medians(), 6)])


def _add_float64(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return xyz, xyz.astype(np.float64)


def _crop_to_max_range(xyz: np.ndarray, params: ClothParams = PARAMS.cloth) -> np.ndarray:
    return xyz.compress((np.abs(xyz[:, :2]) <= params.max_range).all(axis=1), axis=0)


def measure_labelled(frames: list[Frame], repeat: int) -> dict:
    """Measure precision, recall and F1 of our three methods and of the peer's cloth by protocol."""
    problems = {"patchwork": peers.PATCHWORK.find_problem(), peers.CLOTH.name: peers.CLOTH.find_problem()}
    methods: dict[str, Callable] = {
        **{name: partial(_segment_with_ours, name) for name in METHODS},
        peers.CLOTH.name: _segment_with_peer_cloth,
    }
    reports = {name: GroundReport() for name in methods if not problems.get(name)}

    def make_calls(cloud):
        return {name: partial(methods[name], cloud) for name in reports}

    with peers.silence_stdout():
        clock = None
        for frame in show_progress(frames, "ground of labelled scans", len(frames)):
            cloud, point_classes = frame.load(), frame.point_truth().classes
            clock = clock or Clock(min(repeat, SLOW_REPEAT), make_calls(cloud))
            for name, mask in clock.time(make_calls(cloud)).items():
                counts = count_by_protocol(mask, point_classes, cloud.xyz[:, 2])
                reports[name].update(counts, clock.ms[name][-1])
    return {
        "scans": len(frames),
        "protocols": list(PROTOCOLS),
        "methods": {name: reports[name].compute() if name in reports else {"note": problems[name]} for name in methods},
    }


def _segment_with_ours(name: str, frame: PointCloud) -> np.ndarray:
    return METHODS[name](frame.xyz, frame.intensity, PARAMS)


def _segment_with_peer_cloth(cloud: PointCloud) -> np.ndarray:
    indices = np.flatnonzero((np.abs(cloud.xyz[:, :2]) <= PARAMS.cloth.max_range).all(axis=1))
    ground = peers.CLOTH.run(cloud.xyz[indices].astype(np.float64))
    return _to_mask(indices[np.asarray(ground, np.int64)], len(cloud))

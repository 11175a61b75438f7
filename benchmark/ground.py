"""Ground segmentation against its peers."""

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
# Upper limit of the points that both implementations fit a plane to.
MAX_Z = PARAMS.threshold.max_height - SENSOR_HEIGHT


def measure_threshold(title: str, clouds: list[np.ndarray], repeat: int) -> dict:
    """Measure our plane fit and scikit-learn's RANSAC on points (N, 3) below paper A's z < -1.3."""
    peer, points = peers.RANSAC, np.median([len(c) for c in clouds])
    if peer.find_problem():
        return make_measurement(title, len(clouds), points, [make_row(peer.name, note=peer.find_problem())])

    def make_calls(xyz):
        # Selecting the low points is part of the measured time, as in ours.
        return {peer.name: lambda: peer.run(xyz, xyz[:, 2] < MAX_Z), "ours": partial(segment_by_threshold, xyz)}

    clock = Clock(repeat, make_calls(thin_cloud(clouds[0])))
    for xyz in show_progress(clouds, title, len(clouds)):
        clock.time(make_calls(xyz))
    return make_measurement(title, len(clouds), points, [compute_speedup(peer.name, clock.compute_medians(), 3)])


def measure_patchwork(frames: list[PointCloud], repeat: int) -> dict:
    """Measure ours and the bare library on an existing array, with a new object per cloud."""
    title, name = "Patchwork++, full scan", peers.PATCHWORK.name
    points = np.median([len(f) for f in frames])
    if peers.PATCHWORK.find_problem():
        return make_measurement(title, len(frames), points, [make_row(name, note=peers.PATCHWORK.find_problem())])

    def make_calls(frame, cloud):
        return {
            name: partial(peers.PATCHWORK.run, cloud, SENSOR_HEIGHT),
            "ours": partial(segment_by_patchwork, frame.xyz, frame.intensity, SENSOR_HEIGHT),
        }

    same = differ = 0
    with peers.silence_stdout():
        clock = Clock(repeat, make_calls(frames[0], frames[0].points()))
        for frame in show_progress(frames, title, len(frames)):
            masks = clock.time(make_calls(frame, frame.points()))
            different = int((_to_mask(masks[name], len(frame)) != masks["ours"]).sum())
            same, differ = same + (different == 0), differ + different
    return make_measurement(
        title, len(frames), points, [compute_speedup(name, clock.compute_medians(), 1.3, same, differ)]
    )


def _to_mask(indices, count: int) -> np.ndarray:
    mask = np.zeros(count, bool)
    mask[np.asarray(indices, np.int64)] = True
    return mask


def measure_cloth(scans: list[np.ndarray], repeat: int) -> dict:
    """Measure our cloth and the wheel's, of equal resolution, on points within max_range.

    The wheel's time excludes its float64 array and the mask from its indices.
    """
    title, name = "Cloth, full scan", peers.CLOTH.name
    scans = [_crop_to_max_range(xyz) for xyz in scans]
    points = np.median([len(s) for s in scans])
    if peers.CLOTH.find_problem():
        return make_measurement(title, len(scans), points, [make_row(name, note=peers.CLOTH.find_problem())])

    def make_calls(xyz, precise):
        return {name: partial(peers.CLOTH.run, precise), "ours": partial(segment_by_cloth, xyz)}

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
    """Measure precision, recall and F1 of our three methods and the wheel's cloth by protocol."""
    missing = {"patchwork": peers.PATCHWORK.find_problem(), peers.CLOTH.name: peers.CLOTH.find_problem()}
    methods: dict[str, Callable] = {
        **{name: partial(_segment_with_ours, name) for name in METHODS},
        peers.CLOTH.name: _segment_with_wheel,
    }
    reports = {name: GroundReport() for name in methods if not missing.get(name)}

    def make_calls(frame):
        return {name: partial(methods[name], frame) for name in reports}

    with peers.silence_stdout():
        clock = None
        for item in show_progress(frames, "ground of labelled scans", len(frames)):
            frame, semantic = item.load(), item.point_truth().classes
            clock = clock or Clock(min(repeat, SLOW_REPEAT), make_calls(frame))
            for name, mask in clock.time(make_calls(frame)).items():
                counts = count_by_protocol(mask, semantic, frame.xyz[:, 2])
                reports[name].update(counts, clock.ms[name][-1])
    return {
        "scans": len(frames),
        "protocols": list(PROTOCOLS),
        "methods": {name: reports[name].compute() if name in reports else {"note": missing[name]} for name in methods},
    }


def _segment_with_ours(name: str, frame: PointCloud) -> np.ndarray:
    return METHODS[name](frame.xyz, frame.intensity, PARAMS)


def _segment_with_wheel(frame: PointCloud) -> np.ndarray:
    inside = np.flatnonzero((np.abs(frame.xyz[:, :2]) <= PARAMS.cloth.max_range).all(axis=1))
    ground = peers.CLOTH.run(frame.xyz[inside].astype(np.float64))
    return _to_mask(inside[np.asarray(ground, np.int64)], len(frame))

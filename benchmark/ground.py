"""Ground segmentation against its peers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from benchmark import peers
from benchmark.rows import compute_speedup, make_measurement, make_row
from benchmark.timing import SLOW_REPEAT, Clock, choose_evenly, thin
from lidar_perception.data.frame import Frame
from lidar_perception.ground.cloth import segment_by_cloth
from lidar_perception.ground.params import ClothParams, GroundParams, ThresholdParams
from lidar_perception.ground.patchwork import segment_by_patchwork
from lidar_perception.ground.segment import METHODS
from lidar_perception.ground.threshold import (
    fit_plane_by_ransac,
    height_above_plane,
    segment_by_threshold,
)
from lidar_perception.runs.terminal import show_progress
from lidar_perception.scoring.points.segmentation import PROTOCOLS, GroundReport, count_by_protocol
from lidar_perception.types import SENSOR_HEIGHT, PointCloud

PARAMS = GroundParams()
FRAMES_OF_2000 = 3  # scikit-learn's 2000 trials take seconds


def measure_threshold(title: str, clouds: list[np.ndarray], repeat: int) -> dict:
    """Measure our plane fit and scikit-learn's RANSAC on points (N, 3) below paper A's z < -1.3.

    RANSAC runs with and without its early stop. Also measures how much the planes differ.
    """
    rows: list[dict] = []
    planes: dict[str, dict] = {}
    for group, chosen, times in (
            (peers.RANSACS, clouds, repeat),
            ((peers.RANSAC_2000,), choose_evenly(clouds, FRAMES_OF_2000), 1)):
        here = [p for p in group if not p.missing()]
        ms, found = _measure_times(title, chosen, times, here)
        for p in group:
            rows.append(
                compute_speedup(p.name, ms, 20) if p in here else make_row(p.name, note=p.missing())
            )
        planes |= {p.name: _compare_planes(chosen, found[p.name]) for p in here}
    return make_measurement(
        title,
        len(clouds),
        np.median([len(c) for c in clouds]),
        rows,
        planes=planes,
        frames_of_2000_trials=min(FRAMES_OF_2000, len(clouds)),
    )


def _measure_times(title: str, clouds: list[np.ndarray], repeat: int,
                   here: list[peers.Peer]) -> tuple[dict, dict]:
    """Return median times, and the result of each peer on each cloud."""
    def calls(xyz):
        # The low points are chosen within the time, as ours does.
        return {**{p.name: lambda p=p: p.run(xyz, _low(xyz)) for p in here},
                "ours": partial(segment_by_threshold, xyz)}

    clock = Clock(repeat, calls(thin(clouds[0])))
    found = [clock.time(calls(xyz)) for xyz in show_progress(clouds, title, len(clouds))]
    return clock.medians(), {p.name: [f[p.name] for f in found] for p in here}


def _low(xyz: np.ndarray) -> np.ndarray:
    return xyz[:, 2] < PARAMS.threshold.max_height - SENSOR_HEIGHT


def _compare_planes(clouds: list[np.ndarray], found: list[tuple]) -> dict:
    """Compare our planes with theirs, as fitted and refitted to the inliers until stable.

    Returns differences in cm at the sensor and degrees, median and max over frames, and the number
    of frames in which either plane has more inliers.
    """
    low = [xyz[_low(xyz)] for xyz in clouds]
    ours = [fit_plane_by_ransac(points, PARAMS.threshold) for points in low]
    theirs = [plane for _, plane, _ in found]
    settled = [_refit(points.astype(np.float64), plane) for points, plane in zip(low, theirs)]
    trials = float(np.median([trials for _, _, trials in found]))
    result: dict[str, Any] = {"trials": trials, "difference": {}}
    for name, planes in (("raw", theirs), ("refined", settled)):
        pairs = [(a, b) for a, b in zip(ours, planes) if a is not None]
        more = [_inliers(p, a) - _inliers(p, b)
                for p, a, b in zip(low, ours, planes) if a is not None]
        if not pairs:
            continue
        height = [100 * abs(a[2] - b[2]) for a, b in pairs]
        normals = [np.array([[-a[0], -a[1], 1], [-b[0], -b[1], 1]]) for a, b in pairs]
        angle = [np.degrees(np.arctan2(np.linalg.norm(np.cross(*n)), n[0] @ n[1]))
                 for n in normals]
        result["difference"][name] = {
            **{key: {"median": float(np.median(v)), "max": float(np.max(v))}
               for key, v in (("height_cm", height), ("angle_deg", angle))},
            "ours_more": sum(m > 0 for m in more), "its_more": sum(m < 0 for m in more)}
    return result


def _inliers(points: np.ndarray, plane: np.ndarray) -> int:
    height = height_above_plane(points, plane)
    return int((np.abs(height) <= PARAMS.threshold.inlier_distance).sum())


def _refit(points: np.ndarray, plane: np.ndarray,
           params: ThresholdParams = PARAMS.threshold) -> np.ndarray:
    """Refit by least squares until the inliers no longer change."""
    before = None
    for _ in range(100):
        near = np.abs(height_above_plane(points, plane)) <= params.inlier_distance
        if before is not None and np.array_equal(near, before):
            break
        columns = np.column_stack([points[near, :2], np.ones(near.sum())])
        plane, before = np.linalg.lstsq(columns, points[near, 2], rcond=None)[0], near
    return plane


def measure_patchwork(frames: list[PointCloud], repeat: int) -> dict:
    """Measure ours and the bare library on an existing array, with a new object per cloud."""
    title, name = "Patchwork++, whole scan", peers.PATCHWORK.name
    points = np.median([len(f) for f in frames])
    if peers.PATCHWORK.missing():
        return make_measurement(
            title, len(frames), points, [make_row(name, note=peers.PATCHWORK.missing())]
        )

    def calls(frame, cloud):
        return {name: partial(peers.PATCHWORK.run, cloud, SENSOR_HEIGHT),
                "ours": partial(segment_by_patchwork, frame.xyz, frame.intensity, SENSOR_HEIGHT)}

    same = differ = 0
    with peers.silence_stdout():
        clock = Clock(repeat, calls(frames[0], _with_intensity(frames[0])))
        for frame in show_progress(frames, title, len(frames)):
            found = clock.time(calls(frame, _with_intensity(frame)))
            apart = int((_mask(found[name], len(frame)) != found["ours"]).sum())
            same, differ = same + (apart == 0), differ + apart
    return make_measurement(title, len(frames), points, [
        compute_speedup(name, clock.medians(), 1.3, same, differ)])


def _with_intensity(frame: PointCloud) -> np.ndarray:
    return frame.points()


def _mask(indices, count: int) -> np.ndarray:
    mask = np.zeros(count, bool)
    mask[np.asarray(indices, np.int64)] = True
    return mask


def measure_cloth(scans: list[np.ndarray], repeat: int) -> dict:
    """Measure our cloth and the wheel's, of equal resolution, on points within max_range.

    The wheel's time excludes its float64 array and the mask from its indices.
    """
    title, name = "Cloth, whole scan", peers.CLOTH.name
    scans = [_within(xyz) for xyz in scans]
    points = np.median([len(s) for s in scans])
    if peers.CLOTH.missing():
        return make_measurement(
            title, len(scans), points, [make_row(name, note=peers.CLOTH.missing())]
        )

    def calls(xyz, precise):
        return {name: partial(peers.CLOTH.run, precise), "ours": partial(segment_by_cloth, xyz)}

    with peers.silence_stdout():
        clock = Clock(min(repeat, SLOW_REPEAT), calls(*_both(thin(scans[0]))))
        for xyz in show_progress(scans, title, len(scans)):
            clock.time(calls(*_both(xyz)))
    return make_measurement(title, len(scans), points, [compute_speedup(name, clock.medians(), 6)])


def _both(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return xyz, xyz.astype(np.float64)


def _within(xyz: np.ndarray, params: ClothParams = PARAMS.cloth) -> np.ndarray:
    return xyz.compress((np.abs(xyz[:, :2]) <= params.max_range).all(axis=1), axis=0)


def measure_labelled(frames: list[Frame], repeat: int) -> dict:
    """Measure precision, recall and F1 of our three methods and the wheel's cloth by protocol."""
    missing = {"patchwork": peers.PATCHWORK.missing(), peers.CLOTH.name: peers.CLOTH.missing()}
    methods: dict[str, Callable] = {
        **{name: partial(_of_ours, name) for name in METHODS}, peers.CLOTH.name: _of_wheel}
    reports = {name: GroundReport() for name in methods if not missing.get(name)}

    def calls(frame):
        return {name: partial(methods[name], frame) for name in reports}

    with peers.silence_stdout():
        clock = None
        for item in show_progress(frames, "ground of labelled scans", len(frames)):
            frame, semantic = item.load(), item.point_truth().classes
            clock = clock or Clock(min(repeat, SLOW_REPEAT), calls(frame))
            for name, found in clock.time(calls(frame)).items():
                counts = count_by_protocol(found, semantic, frame.xyz[:, 2])
                reports[name].update(counts, clock.ms[name][-1])
    return {"scans": len(frames), "protocols": list(PROTOCOLS),
            "methods": {name: reports[name].compute() if name in reports
                        else {"note": missing[name]} for name in methods}}


def _of_ours(name: str, frame: PointCloud) -> np.ndarray:
    return METHODS[name](frame.xyz, frame.intensity, PARAMS)


def _of_wheel(frame: PointCloud) -> np.ndarray:
    inside = np.flatnonzero((np.abs(frame.xyz[:, :2]) <= PARAMS.cloth.max_range).all(axis=1))
    ground = peers.CLOTH.run(frame.xyz[inside].astype(np.float64))
    return _mask(inside[np.asarray(ground, np.int64)], len(frame))

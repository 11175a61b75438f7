"""Functions of the public interface, with keyword arguments instead of parameter dataclasses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from lidar_perception.candidates.configurations import BEST
from lidar_perception.candidates.pipeline import find_candidates as run_pipeline
from lidar_perception.candidates.seed_sources import make_click_source
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.clustering.params import CLUSTERING_METHODS, ClusteringParams
from lidar_perception.data.frame import BOXES, Recording
from lidar_perception.data.mount_check import apply_measured_height, load_first_clouds
from lidar_perception.data.open import open_recording
from lidar_perception.detectors.automatic_seed import make_automatic_source
from lidar_perception.detectors.contract import FUSED, Detector
from lidar_perception.detectors.custom import as_detector
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.params import MIN_SCORE
from lidar_perception.ground import segment
from lidar_perception.ground.params import GROUND_METHODS, GroundParams
from lidar_perception.param_fields import with_values
from lidar_perception.scoring.detections import measure_detector
from lidar_perception.scoring.kitti.report import DetectionReport
from lidar_perception.scoring.run import SkipReason, measure_frames
from lidar_perception.simulation.recording import simulate_recording
from lidar_perception.simulation.scene import Scenes
from lidar_perception.simulation.sensor import find_sensor
from lidar_perception.types import (
    SENSOR_HEIGHT,
    Detections,
    InputError,
    PointCloud,
    as_point_cloud,
    make_unknown_name_error,
)

P = TypeVar("P")  # any parameter dataclass


def load_detector(
    name_or_file: str | Path = FUSED,
    *,
    device: str = "auto",
    range: str = "auto",
    sensor_height: float | None = None,
    min_score: float | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Detector:
    """Load a detector. `detector(cloud).detections` holds the objects found in a cloud.

    Args:
        name_or_file: a detector with the weights of the package (fused, pointpillars or pointnet);
            a file of weights (.safetensors, .onnx or the .json of `train fused`); or a class of
            your own, as "module:Class" or by the name of its entry point.
        device: auto, cpu, cuda or cuda:N.
        range: ahead, around, or auto (the range that the weights were trained for).
        sensor_height: height of the sensor above the ground in metres. Default: 1.73, as in KITTI.
        min_score: score threshold of every class, 0..1. Default: the thresholds of the detector.
        settings: other parameters by dotted name, such as {"fused.scores.car": 0.7}; they take
            precedence over the arguments above.

    Raises:
        InputError: the detector cannot be loaded, or an argument is unknown or out of range.
    """
    return open_detector(
        name_or_file, device, sensor_height=sensor_height, min_score=min_score, range=range, settings=settings or {}
    )


def segment_ground(
    xyz: PointCloud | ArrayLike,
    method: str = "threshold",
    *,
    sensor_height: float = SENSOR_HEIGHT,
    intensity: ArrayLike | None = None,
    **params: Any,
) -> np.ndarray:
    """Segment the ground points of a cloud.

    Args:
        xyz: (N, 3) [x y z] or (N, 4) [x y z intensity] of a level sensor, metres, z up; or a
            PointCloud.
        method: threshold (one plane), patchwork (Patchwork++) or cloth (cloth simulation).
        sensor_height: height of the sensor above the ground, in metres.
        intensity: (N,) for xyz (N, 3); only patchwork uses it, to remove reflections.
        params: parameters of the method, such as max_range=60.0 of patchwork. They are the
            parameters of the node ground_segmentation without the prefix ground.METHOD.

    Returns:
        (N,) bool, True = ground. It is False for points that are not finite or at the origin.

    Raises:
        InputError: xyz or intensity has a wrong shape, or the method or a parameter is unknown or
            out of range.
    """
    if method not in GROUND_METHODS:
        raise make_unknown_name_error("ground method", method, GROUND_METHODS)
    defaults = GroundParams()
    pose = _set_params(defaults.sensor_pose, {"height": sensor_height})
    method_params = _set_params(getattr(defaults, method), params)
    return segment.segment_ground(
        as_point_cloud(xyz, intensity), replace(defaults, method=method, sensor_pose=pose, **{method: method_params})
    )


def cluster(
    xyz: PointCloud | ArrayLike,
    method: str = "dbscan",
    *,
    ground: ArrayLike | None = None,
    density: float = 0.0,
    **params: Any,
) -> np.ndarray:
    """Cluster the points of a cloud.

    Args:
        xyz: (N, 3) [x y z] or (N, 4) [x y z intensity], metres; or a PointCloud.
        method: dbscan (eps grows with the range) or euclidean (adaptive).
        ground: (N,) bool; True = not clustered. Default: all points are clustered.
        density: points per square degree for which the parameters are tuned; they are adapted to
            sparser clouds. 0: no adaptation.
        params: parameters of the method, such as min_samples=5 of dbscan. They are the parameters
            of the node clustering without the prefix clustering.METHOD.

    Returns:
        (N,) int32 cluster ids 1..K, 0 for ground and points without a cluster.

    Raises:
        InputError: xyz or ground has a wrong shape, or the method or a parameter is unknown or
            out of range.
    """
    if method not in CLUSTERING_METHODS:
        raise make_unknown_name_error("clustering method", method, CLUSTERING_METHODS)
    defaults = ClusteringParams()
    method_params = _set_params(getattr(defaults, method), params)
    clustering_params = _set_params(replace(defaults, method=method, **{method: method_params}), {"density": density})
    cloud = as_point_cloud(xyz)
    mask = np.zeros(len(cloud), bool) if ground is None else np.asarray(ground)
    return cluster_obstacles(cloud, mask, clustering_params)


def find_candidates(
    xyz: PointCloud | ArrayLike,
    *,
    click: ArrayLike | None = None,
    sensor_height: float = SENSOR_HEIGHT,
    ground: np.ndarray | None = None,
    cluster_ids: np.ndarray | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Detections:
    """Find pedestrian candidates by silhouettes (STM-CPA, configuration `best`).

    Args:
        xyz: (N, 3) [x y z] or (N, 4) [x y z intensity], metres, z up; or a PointCloud.
        click: (3,) a point on a pedestrian, whose silhouette becomes the template. Default: the
            clusters that PointNet classifies as pedestrians.
        sensor_height: height of the sensor above the ground, in metres.
        ground: (N,) bool, for example from segment_ground(). Default: computed here.
        cluster_ids: (N,) int, for example from cluster(). Default: computed here.
        settings: other parameters of the node perception by dotted name, such as
            {"stm.threshold": 0.5}.

    Returns:
        The candidates as pedestrians, with their confidence as score.

    Raises:
        InputError: an array has a wrong shape, no cluster is at `click`, or a parameter is unknown
            or out of range.
    """
    params = _set_params(BEST, {"view.enabled": False, "ground.sensor_pose.height": sensor_height, **(settings or {})})
    seed = (
        make_automatic_source(params.seed)
        if click is None
        else make_click_source(np.asarray(click, float), params.seed)
    )
    _, candidates = run_pipeline(xyz, seed, None, params, ground=ground, cluster_ids=cluster_ids)
    return candidates.final


def evaluate(
    detector: str | Path | Detector | Callable[[PointCloud], Detections],
    recording: str | Path | Recording,
    *,
    limit: int | None = None,
    min_score: float | None = MIN_SCORE,
    intervals: int = 0,
) -> dict[str, Any]:
    """Score a detector on the labelled frames of a recording, as `evaluate detection` does.

    Args:
        detector: a loaded detector, a function that returns Detections for a PointCloud, or a name
            or file for load_detector(), which is loaded for the recording's sensor height.
        recording: an open recording, or its path.
        limit: maximum number of frames. Default: all.
        min_score: score threshold of every class. The default is low because average precision
            needs boxes with low scores. None: the thresholds of the detector.
        intervals: number of bootstrap resamples for 90 % confidence intervals; 0: none.

    Returns:
        The content of the JSON file of `evaluate detection`, such as
        `result["ap"]["Car"]["3d"]["moderate"]["r40"]`, an average precision in percent. `skipped`
        lists the frames that were not scored.

    Raises:
        InputError: the recording or the detector cannot be used, or no frame has labels.
    """
    if not isinstance(recording, Recording):
        recording = open_recording(recording)
    recording.require(BOXES, "evaluate")
    if isinstance(detector, (str, Path)):
        recording = apply_measured_height(recording, load_first_clouds(recording))
        loaded: Detector = open_detector(detector, min_score=min_score, sensor_height=recording.frames[0].sensor_height)
    else:
        loaded = as_detector(detector)
        loaded = loaded if min_score is None else loaded.with_min_score(min_score)
    report = DetectionReport(sequential=recording.is_sequential)
    start = partial(measure_detector, lambda: loaded, 1.0, None)
    numbers = range(min(len(recording), limit or len(recording)))
    for _, result in measure_frames(recording, start, numbers):
        if isinstance(result, SkipReason):
            report.skipped.append(str(result))
        elif result is not None:
            report.update(result)
    if not report.frames:
        reason = f" ({report.skipped[0]})" if report.skipped else ""
        raise InputError(f"{recording.path}: no frame with labels{reason}")
    content = report.compute()
    return {**content, "intervals": report.compute_intervals(intervals)} if intervals else content


def simulate(
    frames: int = 40,
    seed: int = 1,
    sensor: str = "hdl64e",
    scene: str = "street",
    *,
    kind: str | None = None,
    people: float = 1.0,
    sensor_height: float | None = None,
) -> Recording:
    """Simulate labelled scans. Each scan is computed when it is read.

    Args:
        frames: number of scans. A new scene starts after each drive of 20 s.
        seed: random seed of the first scene; the same seed gives the same scans.
        sensor: name of a preset, such as vlp-16, or a .yaml file written by `setup`.
        scene: street, campus or another scene of `simulate`, or several, such as street,campus.
        kind: kind of the scene. Default: all kinds in turn.
        people: number of pedestrians and cyclists, as a multiple of the usual number.
        sensor_height: metres above the ground. Default: the height in the preset or file.

    Returns:
        A recording, to iterate over or to pass to evaluate(). frame.load() returns the cloud of a
        frame, frame.truth() its labels.

    Raises:
        InputError: an argument is unknown or out of range.
    """
    for name, value, low in (("frames", frames, 1), ("seed", seed, 0)):
        if value < low:
            raise InputError(f"{name} = {value} must be {low} or more")
    return simulate_recording(
        seed, frames, find_sensor(sensor, sensor_height or 0.0), scenes=Scenes(kind, people, scene)
    )


def _set_params(params: P, values: Mapping[str, Any]) -> P:
    try:
        return with_values(params, values)
    except ValueError as error:
        raise InputError(str(error)) from None

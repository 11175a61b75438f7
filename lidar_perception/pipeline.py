"""The order of the stages, in one place: one LiDAR frame in, pedestrian candidates out.

    view -> ground -> clusters -> boxes snapped to the ground -> height -> STM -> CPA

The nodes call the same stage functions one by one, so that the graph over DDS and this file give
the same candidates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np

from lidar_perception.camera import Camera
from lidar_perception.candidates.boxes import snap_to_ground
from lidar_perception.candidates.confidence import confidence, shape_features
from lidar_perception.candidates.refine import Candidates, group_points, refine
from lidar_perception.candidates.seeds import (
    MIN_POINTS,
    Seed,
    seed_from_click,
    seed_from_points,
    seed_from_truth,
)
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.clustering.shapes import oriented_boxes
from lidar_perception.ground.segment import segment_ground
from lidar_perception.ground.threshold import fit_plane
from lidar_perception.params import (
    PipelineParams,
    SeedParams,
    ViewParams,
    with_values,
)
from lidar_perception.types import InputError, LidarFrame


@dataclass(frozen=True)
class Segmented:
    """Ground, clusters and boxes of the M points of a frame that are in view.

    places (M,) int64 their rows in the frame, xyz (M, 3) float32, ground (M,) bool, cluster_ids
    (M,) int32 with 0 = none, boxes (K, 7) float32 of clusters 1..K down to the ground plane;
    ms per step.
    """

    places: np.ndarray
    xyz: np.ndarray
    ground: np.ndarray
    cluster_ids: np.ndarray
    boxes: np.ndarray
    ms: dict[str, float] = field(default_factory=dict)


# Where the seed comes from, given the frame's clusters.
SeedSource = Callable[[Segmented], Seed]


def points_in_view(frame: LidarFrame, camera: Camera | None,
                   params: ViewParams) -> tuple[np.ndarray, LidarFrame]:
    """places (M,) int64 of the points of the frame in the camera's view, and the frame of these;
    all of them while the crop is off. InputError if it is on and there is no camera."""
    if not params.enabled:
        return np.arange(len(frame)), frame
    if camera is None:
        raise InputError("view.enabled is on but there is no camera calibration; give CameraInfo "
                         "and the LiDAR-to-camera transform, or set view.enabled to false")
    places = np.flatnonzero(camera.in_view(frame.xyz))
    return places, frame.take(places)


def grounded_boxes(xyz: np.ndarray, ground: np.ndarray, cluster_ids: np.ndarray,
                   shape: str) -> np.ndarray:
    """(K, 7) boxes of clusters 1..K, of a shape of params.BOX_SHAPES, down to the plane through
    the ground points."""
    return snap_to_ground(oriented_boxes(xyz, cluster_ids, shape),
                          fit_plane(xyz.compress(ground, axis=0)))


def segment(frame: LidarFrame, camera: Camera | None = None,
            params: PipelineParams = PipelineParams()) -> Segmented:
    """Stages up to the boxes. InputError if the crop is on and there is no camera."""
    t0 = perf_counter()
    places, seen = points_in_view(frame, camera, params.view)
    t1 = perf_counter()
    ground = segment_ground(seen, params.ground)
    t2 = perf_counter()
    cluster_ids = cluster_obstacles(seen.xyz, ground, params.clustering)
    t3 = perf_counter()
    boxes = grounded_boxes(seen.xyz, ground, cluster_ids, params.boxes.shape)
    t4 = perf_counter()
    ms = dict(view=t1 - t0, ground=t2 - t1, clustering=t3 - t2, boxes=t4 - t3)
    return Segmented(places, seen.xyz, ground, cluster_ids, boxes,
                     {k: v * 1e3 for k, v in ms.items()})


def explain_nothing(usable: int, ground: np.ndarray,
                    cluster_ids: np.ndarray | None = None) -> str | None:
    """Why a frame can have no candidates, with the remedy; None if nothing is wrong so far.

    usable is the number of finite points; ground (M,) and cluster_ids (M,) of those in view.
    """
    if usable == 0:
        return "the cloud is empty or has no finite point"
    if len(ground) == 0:
        return "no point is in the camera's view; check the LiDAR-to-camera transform"
    if not ground.any():
        return ("no ground found; is the sensor mounted at another height or angle? set "
                "ground.sensor_pose")
    if cluster_ids is not None and not cluster_ids.any():
        return ("no clusters; are the numbers of clustering.dbscan or clustering.euclidean right "
                "for this sensor?")
    return None


def find_candidates(frame: LidarFrame, seed: SeedSource, camera: Camera | None = None,
                    params: PipelineParams = PipelineParams()) -> tuple[Segmented, Candidates]:
    """The whole pipeline on one frame; ms of the result covers every step of params.STEPS.

    InputError where the seed source has no seed for this frame.
    """
    segmented = segment(frame, camera, params)
    return segmented, refined(segmented, seed, params)


def refined(segmented: Segmented, seed: SeedSource,
            params: PipelineParams = PipelineParams()) -> Candidates:
    """The candidates among a frame's clusters. InputError where there is no seed."""
    found = refine(segmented.xyz, segmented.cluster_ids, segmented.boxes, seed(segmented), params)
    return replace(found, ms={**segmented.ms, **found.ms})


def truth_seed(pedestrians: np.ndarray) -> SeedSource:
    """Nearest pedestrian of boxes (M, 7), the paper's protocol."""
    return lambda s: seed_from_truth(s.xyz, s.ground, pedestrians)


def clicked_seed(click: np.ndarray, params: SeedParams = SeedParams()) -> SeedSource:
    """The cluster at a point (3,) in the LiDAR frame."""
    return lambda s: seed_from_click(click, s.xyz, s.cluster_ids, s.boxes, params.click_radius)


def automatic_seed(template: Seed, params: PipelineParams) -> SeedSource:
    """The cluster of the frame that is most like a pedestrian, or the template where none is."""
    def source(s: Segmented) -> Seed:
        clusters = np.arange(1, len(s.boxes) + 1)
        likely = confidence(shape_features(*group_points(s.xyz, s.cluster_ids, clusters), s.boxes,
                                           params))
        likely[np.bincount(s.cluster_ids, minlength=len(s.boxes) + 1)[1:] < MIN_POINTS] = 0.0
        if likely.max(initial=0.0) < params.seed.least_confidence:
            return template
        best = int(likely.argmax())
        return seed_from_points(s.xyz[s.cluster_ids == best + 1], s.boxes[best])
    return source


def fixed_seed(seed: Seed) -> SeedSource:
    """The same seed in every frame."""
    return lambda s: seed


def warm_up() -> None:
    """Run every stage and method once on a few made-up points, so that compiled code is loaded (or
    built and cached, the first time) before the first message arrives."""
    rng = np.random.default_rng(0)
    flat = rng.uniform(-20, 20, (600, 3)) * [1, 1, 0.001] - [0, 0, 1.7]
    person = rng.uniform(-0.5, 0.5, (400, 3)) * [0.5, 0.5, 1.7] + [8, 0, -0.8]
    dense = rng.uniform(-0.05, 0.05, (2000, 3)) + [8, 2, 0]  # takes another way through DBSCAN
    xyz = np.concatenate([flat, person, person + [12, 0, 0], dense]).astype(np.float32)
    seed = seed_from_points(person.astype(np.float32), np.array([8, 0, -0.85, 1, 1, 1.7, 0]))
    forward = Camera(np.array([[50, -100, 0, 0], [50, 0, -100, 0], [1, 0, 0, 0]], float), 100, 100)
    base = PipelineParams(view=ViewParams(enabled=True))
    for ground, clustering, boxes, sure in (("threshold", "dbscan", "axis_aligned", False),
                                            ("cloth", "euclidean", "l_shape", True)):
        params = with_values(base, {
            "ground.method": ground, "clustering.method": clustering, "boxes.shape": boxes,
            "confidence.enabled": sure, "seed.least_confidence": 0.0})
        find_candidates(LidarFrame(xyz), automatic_seed(seed, params), forward, params)

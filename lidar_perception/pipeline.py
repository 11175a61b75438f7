"""The order of the stages, in one place: one LiDAR frame in, pedestrian candidates out.

    view -> ground -> clusters -> boxes snapped to the ground -> height -> STM -> CPA

The nodes call the same stage functions one by one, so that the graph over DDS and this file give
the same candidates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from lidar_perception.camera import Camera
from lidar_perception.candidates.boxes import cluster_boxes, snap_to_ground
from lidar_perception.candidates.refine import Candidates, refine
from lidar_perception.candidates.seeds import (
    Seed,
    load_seed,
    seed_from_click,
    seed_from_points,
    seed_from_truth,
)
from lidar_perception.clustering.dbscan import distance_aware_dbscan
from lidar_perception.ground.threshold import fit_plane, segment_ground
from lidar_perception.params import DbscanParams, GroundParams, PipelineParams, SeedParams
from lidar_perception.types import InputError, LidarFrame

STEPS = ("view", "ground", "clustering", "boxes", "height", "stm", "cpa")


@dataclass(frozen=True)
class Segmented:
    """Ground, cluster ids and boxes of N points: in_view and ground (N,) bool, cluster_ids (N,)
    int32 with 0 = none, boxes (K, 7) float32 of clusters 1..K on the ground plane; ms per step."""

    in_view: np.ndarray
    ground: np.ndarray
    cluster_ids: np.ndarray
    boxes: np.ndarray
    ms: dict[str, float]


# Where the seed comes from, given the frame's clusters.
SeedSource = Callable[[LidarFrame, Segmented], Seed]


def ground_in_view(xyz: np.ndarray, in_view: np.ndarray, params: GroundParams) -> np.ndarray:
    """(N,) bool ground among the points in view; False for all others."""
    if in_view.all():
        return segment_ground(xyz, params)
    seen = np.flatnonzero(in_view)
    ground = np.zeros(len(xyz), bool)
    ground[seen] = segment_ground(xyz[seen], params)
    return ground


def cluster_obstacles(xyz: np.ndarray, obstacle: np.ndarray, params: DbscanParams) -> np.ndarray:
    """(N,) int32 cluster ids of the points under mask obstacle; 0 for all others."""
    labels = np.zeros(len(xyz), np.int32)
    members = np.flatnonzero(obstacle)
    labels[members] = distance_aware_dbscan(xyz[members], params)
    return labels


def grounded_boxes(xyz: np.ndarray, ground: np.ndarray, cluster_ids: np.ndarray) -> np.ndarray:
    """(K, 7) boxes of clusters 1..K, down to the plane through the ground points."""
    return snap_to_ground(cluster_boxes(xyz, cluster_ids), fit_plane(xyz[ground]))


def segment(frame: LidarFrame, camera: Camera | None = None,
            params: PipelineParams = PipelineParams()) -> Segmented:
    """Stages up to the boxes. InputError if the crop is on and there is no camera."""
    xyz = frame.xyz
    t0 = perf_counter()
    in_view = view_mask(xyz, camera, params)
    t1 = perf_counter()
    ground = ground_in_view(xyz, in_view, params.ground)
    t2 = perf_counter()
    cluster_ids = cluster_obstacles(xyz, in_view & ~ground, params.dbscan)
    t3 = perf_counter()
    boxes = grounded_boxes(xyz, ground, cluster_ids)
    t4 = perf_counter()
    ms = dict(view=t1 - t0, ground=t2 - t1, clustering=t3 - t2, boxes=t4 - t3)
    return Segmented(in_view, ground, cluster_ids, boxes, {k: v * 1e3 for k, v in ms.items()})


def view_mask(xyz: np.ndarray, camera: Camera | None, params: PipelineParams) -> np.ndarray:
    """(N,) bool: in the camera's view, or all True while the crop is off."""
    if not params.view.enabled:
        return np.ones(len(xyz), bool)
    if camera is None:
        raise InputError("view.enabled is on but there is no camera calibration; give CameraInfo "
                         "and the LiDAR-to-camera transform, or set view.enabled to false")
    return camera.in_view(xyz)


def find_candidates(frame: LidarFrame, seed: SeedSource, camera: Camera | None = None,
                    params: PipelineParams = PipelineParams()) -> tuple[Segmented, Candidates]:
    """The whole pipeline on one frame; ms of the result covers every step of STEPS.

    InputError where the seed source has no seed for this frame.
    """
    segmented = segment(frame, camera, params)
    return segmented, refined(frame, segmented, seed, params)


def refined(frame: LidarFrame, segmented: Segmented, seed: SeedSource,
            params: PipelineParams = PipelineParams()) -> Candidates:
    """The candidates among a frame's clusters. InputError where there is no seed."""
    found = refine(frame.xyz, segmented.cluster_ids, segmented.boxes, seed(frame, segmented),
                   params)
    return replace(found, ms={**segmented.ms, **found.ms})


def truth_seed(pedestrians: np.ndarray) -> SeedSource:
    """Nearest pedestrian of boxes (M, 7), the paper's protocol."""
    return lambda frame, s: seed_from_truth(frame.xyz, s.ground, pedestrians)


def clicked_seed(click: np.ndarray, params: SeedParams = SeedParams()) -> SeedSource:
    """The cluster at a point (3,) in the LiDAR frame."""
    return lambda frame, s: seed_from_click(click, frame.xyz, s.cluster_ids, s.boxes,
                                            params.click_radius)


def fixed_seed(seed: Seed) -> SeedSource:
    return lambda frame, s: seed


def warm_up() -> None:
    """Run every stage once on a few made-up points, so that compiled code is loaded (or built and
    cached, the first time) before the first message arrives."""
    rng = np.random.default_rng(0)
    flat = rng.uniform(-20, 20, (600, 3)) * [1, 1, 0.001] - [0, 0, 1.7]
    person = rng.uniform(-0.5, 0.5, (400, 3)) * [0.5, 0.5, 1.7] + [8, 0, -0.8]
    xyz = np.concatenate([flat, person, person + [12, 0, 0]]).astype(np.float32)
    seed = seed_from_points(person.astype(np.float32), 1.7)
    find_candidates(LidarFrame(xyz), fixed_seed(seed))


__all__ = ["STEPS", "Segmented", "clicked_seed", "cluster_obstacles", "find_candidates",
           "fixed_seed", "ground_in_view", "grounded_boxes", "load_seed", "refined",
           "segment", "truth_seed", "view_mask", "warm_up"]

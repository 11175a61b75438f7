"""The order of the stages, in one place: one LiDAR frame in, pedestrian candidates out.

    crop, view -> ground -> clusters -> boxes snapped to the ground -> height -> STM -> CPA

The nodes call the same stage functions one by one, so that the graph over DDS and this file give
the same candidates.
"""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np
from numpy.typing import ArrayLike

from lidar_perception.camera import Camera
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.refine import Candidates, refine
from lidar_perception.candidates.seed_sources import SeedSource
from lidar_perception.candidates.segmented import Segmented, grounded_boxes, points_in_view
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.ground.segment import crop_with_sensor_pose, segment_ground
from lidar_perception.groups import renumbered
from lidar_perception.types import LidarFrame, as_frame, check_columns


def segment(cloud: LidarFrame | ArrayLike, camera: Camera | None = None,
            params: PipelineParams = PipelineParams(), *, ground: np.ndarray | None = None,
            cluster_ids: np.ndarray | None = None) -> Segmented:
    """Run the stages up to the boxes on a LidarFrame, or an array (N, 3) or (N, 4) as LidarFrame.of
    takes it. ground (N,) bool and cluster_ids (N,) of its points, from any clustering, are computed
    where they are None. InputError if the view is on and there is no camera, for other arrays, and
    for columns of another length."""
    t0 = perf_counter()
    frame = as_frame(cloud)
    check_columns(len(frame), ground=ground, cluster_ids=cluster_ids)
    kept, frame = crop_with_sensor_pose(frame, params.crop, params.ground.sensor_pose)
    indices, seen = points_in_view(frame, camera, params.view)
    indices = kept.take(indices)
    t1 = perf_counter()
    ground = (segment_ground(seen, params.ground) if ground is None else
              np.asarray(ground, bool)[indices])
    t2 = perf_counter()
    numbers = None
    if cluster_ids is None:
        cluster_ids = cluster_obstacles(seen.xyz, ground, params.clustering)
    else:
        cluster_ids, numbers = renumbered(np.asarray(cluster_ids)[indices])
    t3 = perf_counter()
    boxes = grounded_boxes(seen.xyz, ground, cluster_ids, params.boxes.shape)
    t4 = perf_counter()
    ms = dict(view=t1 - t0, ground=t2 - t1, clustering=t3 - t2, boxes=t4 - t3)
    return Segmented(indices, seen.xyz, ground, cluster_ids, boxes, numbers,
                     ms={k: v * 1e3 for k, v in ms.items()})


def find_candidates(cloud: LidarFrame | ArrayLike, seed: SeedSource, camera: Camera | None = None,
                    params: PipelineParams = PipelineParams(),
                    **columns: np.ndarray | None) -> tuple[Segmented, Candidates]:
    """Run the whole pipeline on one cloud; ms of the result covers every step of params.STEPS;
    cloud and columns as in segment(). InputError where the seed source has no seed for it."""
    segmented = segment(cloud, camera, params, **columns)
    return segmented, refined(segmented, seed, params)


def refined(segmented: Segmented, seed: SeedSource,
            params: PipelineParams = PipelineParams()) -> Candidates:
    """The candidates among a frame's clusters, by the numbers that the cloud gives these.
    InputError where there is no seed."""
    found = refine(segmented.xyz, segmented.cluster_ids, segmented.boxes, seed(segmented), params)
    clusters = found.clusters
    if segmented.numbers is not None:
        clusters = segmented.numbers[clusters - 1]
    return replace(found, clusters=clusters, ms={**segmented.ms, **found.ms})

"""Candidate pipeline, which finds pedestrian candidates in a cloud.

    crop, view -> ground -> clusters -> boxes snapped to the ground -> height -> STM -> CPA

The nodes call the same functions, so the ROS graph gives the same candidates.
"""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np
from numpy.typing import ArrayLike

from lidar_perception.camera import Camera
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.refine import Candidates, refine_clusters
from lidar_perception.candidates.seed_sources import SeedSource
from lidar_perception.candidates.segmented_cloud import SegmentedCloud, crop_to_view, fit_grounded_boxes
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.ground.segment import crop_with_sensor_pose, segment_ground
from lidar_perception.groups import renumber_ids
from lidar_perception.types import PointCloud, as_point_cloud, check_columns


def segment_cloud(
    cloud: PointCloud | ArrayLike,
    camera: Camera | None = None,
    params: PipelineParams = PipelineParams(),
    *,
    ground: np.ndarray | None = None,
    cluster_ids: np.ndarray | None = None,
) -> SegmentedCloud:
    """Run the stages of the pipeline up to the boxes.

    Args:
        cloud: A PointCloud, or an array (N, 3) or (N, 4) as for PointCloud.of.
        camera: Camera, required if params.view is enabled.
        ground: (N,) bool mask of the ground points; computed if None.
        cluster_ids: (N,) ids from any clustering; computed if None.

    Raises:
        InputError: The camera is missing, or an array has the wrong shape or length.
    """
    t0 = perf_counter()
    frame = as_point_cloud(cloud)
    check_columns(len(frame), ground=ground, cluster_ids=cluster_ids)
    cropped_indices, frame = crop_with_sensor_pose(frame, params.crop, params.ground.sensor_pose)
    indices, view_cloud = crop_to_view(frame, camera, params.view)
    indices = cropped_indices.take(indices)
    t1 = perf_counter()
    ground = segment_ground(view_cloud, params.ground) if ground is None else np.asarray(ground, bool)[indices]
    t2 = perf_counter()
    original_ids = None
    if cluster_ids is None:
        cluster_ids = cluster_obstacles(view_cloud.xyz, ground, params.clustering)
    else:
        cluster_ids, original_ids = renumber_ids(np.asarray(cluster_ids)[indices])
    t3 = perf_counter()
    boxes = fit_grounded_boxes(view_cloud.xyz, ground, cluster_ids, params.boxes)
    t4 = perf_counter()
    ms = dict(view=t1 - t0, ground=t2 - t1, clustering=t3 - t2, boxes=t4 - t3)
    return SegmentedCloud(
        indices,
        view_cloud.xyz,
        ground,
        cluster_ids,
        boxes,
        original_ids,
        view_cloud.intensity,
        {k: v * 1e3 for k, v in ms.items()},
    )


def find_candidates(
    cloud: PointCloud | ArrayLike,
    seed: SeedSource,
    camera: Camera | None = None,
    params: PipelineParams = PipelineParams(),
    **columns: np.ndarray | None,
) -> tuple[SegmentedCloud, Candidates]:
    """Run all stages of the pipeline on one cloud, with the arguments of segment_cloud and a seed source.

    Returns:
        The segmented cloud and the candidates, whose `ms` has the durations of all STEPS.

    Raises:
        InputError: The seed source has no seed for this cloud.
    """
    segmented = segment_cloud(cloud, camera, params, **columns)
    return segmented, refine_segmented(segmented, seed, params)


def refine_segmented(
    segmented: SegmentedCloud, seed: SeedSource, params: PipelineParams = PipelineParams()
) -> Candidates:
    """Find the candidates among the clusters of a segmented cloud. Clusters keep their original ids.

    Raises:
        InputError: The seed source has no seed for this cloud.
    """
    candidates = refine_clusters(segmented.xyz, segmented.cluster_ids, segmented.boxes, seed(segmented), params)
    clusters = candidates.clusters
    if segmented.original_ids is not None:
        clusters = segmented.original_ids[clusters - 1]
    return replace(candidates, clusters=clusters, ms={**segmented.ms, **candidates.ms})

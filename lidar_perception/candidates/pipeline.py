"""The candidate pipeline: one cloud in, pedestrian candidates out.

    crop, view -> ground -> clusters -> boxes snapped to the ground -> height -> STM -> CPA

The nodes call the same stage functions one by one, so that the graph over DDS gives the same
candidates.
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
    """Run the stages up to the boxes.

    Args:
        cloud: a PointCloud, or an array (N, 3) or (N, 4) as PointCloud.of takes it.
        ground, cluster_ids: (N,) bool and (N,) ids from any clustering; computed if None.

    Raises:
        InputError: for an enabled view without a camera, for other arrays, and for columns of
            another length.
    """
    t0 = perf_counter()
    frame = as_point_cloud(cloud)
    check_columns(len(frame), ground=ground, cluster_ids=cluster_ids)
    kept, frame = crop_with_sensor_pose(frame, params.crop, params.ground.sensor_pose)
    indices, seen = crop_to_view(frame, camera, params.view)
    indices = kept.take(indices)
    t1 = perf_counter()
    ground = segment_ground(seen, params.ground) if ground is None else np.asarray(ground, bool)[indices]
    t2 = perf_counter()
    numbers = None
    if cluster_ids is None:
        cluster_ids = cluster_obstacles(seen.xyz, ground, params.clustering)
    else:
        cluster_ids, numbers = renumber_ids(np.asarray(cluster_ids)[indices])
    t3 = perf_counter()
    boxes = fit_grounded_boxes(seen.xyz, ground, cluster_ids, params.boxes)
    t4 = perf_counter()
    ms = dict(view=t1 - t0, ground=t2 - t1, clustering=t3 - t2, boxes=t4 - t3)
    return SegmentedCloud(
        indices, seen.xyz, ground, cluster_ids, boxes, numbers, ms={k: v * 1e3 for k, v in ms.items()}
    )


def find_candidates(
    cloud: PointCloud | ArrayLike,
    seed: SeedSource,
    camera: Camera | None = None,
    params: PipelineParams = PipelineParams(),
    **columns: np.ndarray | None,
) -> tuple[SegmentedCloud, Candidates]:
    """Run the whole pipeline on one cloud.

    cloud and columns are those of segment_cloud(). `ms` of the candidates covers every step of
    params.STEPS.

    Raises:
        InputError: if the seed source has no seed for this cloud.
    """
    segmented = segment_cloud(cloud, camera, params, **columns)
    return segmented, refine_segmented(segmented, seed, params)


def refine_segmented(
    segmented: SegmentedCloud, seed: SeedSource, params: PipelineParams = PipelineParams()
) -> Candidates:
    """Find the candidates among the clusters of a cloud, and name clusters by the cloud's ids.

    Raises:
        InputError: if there is no seed.
    """
    found = refine_clusters(segmented.xyz, segmented.cluster_ids, segmented.boxes, seed(segmented), params)
    clusters = found.clusters
    if segmented.numbers is not None:
        clusters = segmented.numbers[clusters - 1]
    return replace(found, clusters=clusters, ms={**segmented.ms, **found.ms})

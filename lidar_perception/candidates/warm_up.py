"""Warm-up of the candidate pipeline, which compiles or loads its code before the first cloud.

Nodes warm up only the methods that their parameters select. If a parameter selects another method
later, it is compiled then.
"""

from __future__ import annotations

import numpy as np

from lidar_perception.camera import Camera
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import find_candidates
from lidar_perception.candidates.seed_sources import make_fixed_source
from lidar_perception.candidates.seeds import seed_from_points
from lidar_perception.candidates.segmented_cloud import crop_to_view, fit_grounded_boxes
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.clustering.euclidean import cluster_euclidean
from lidar_perception.clustering.params import BoxParams, ClusteringParams
from lidar_perception.ground.params import GroundParams
from lidar_perception.ground.segment import segment_ground
from lidar_perception.ground.threshold import compute_inlier_fraction, fit_plane
from lidar_perception.param_fields import with_values
from lidar_perception.runs.compiling import report_compilation
from lidar_perception.types import PointCloud
from lidar_perception.wire.params import ViewParams

CAMERA = Camera(np.array([[50, -100, 0, 0], [50, 0, -100, 0], [1, 0, 0, 0]], float), 100, 100)


@report_compilation(full_detector=True)
def warm_up() -> None:
    """Run every stage and method once on synthetic points to trigger JIT compilation."""
    for ground, clustering, boxes, with_confidence in (
        ("threshold", "dbscan", "axis_aligned", False),
        ("cloth", "euclidean", "l_shape", True),
    ):
        warm_up_candidates(
            with_values(
                PipelineParams(view=ViewParams(enabled=True)),
                {
                    "ground.method": ground,
                    "clustering.method": clustering,
                    "boxes.shape": boxes,
                    "clustering.dbscan.join_bands": True,
                    "confidence.enabled": with_confidence,
                },
            )
        )
    for threshold in ("local", "global"):
        _warm_up_tree(with_values(ClusteringParams(), {"method": "euclidean", "euclidean.threshold": threshold}))


def warm_up_ground(params: GroundParams, view: ViewParams = ViewParams()) -> None:
    """Compile the ground segmentation, and the plane fit for its diagnostics."""
    cloud = _make_cloud()
    _, cloud = crop_to_view(cloud, CAMERA, view)
    segment_ground(cloud, params)
    plane = fit_plane(cloud.xyz)
    if plane is not None:
        compute_inlier_fraction(cloud.xyz, plane)


def warm_up_clustering(params: ClusteringParams, boxes: BoxParams) -> None:
    """Compile the clustering, including its code for dense clouds, and the box fit."""
    cloud = _make_cloud()
    ground = np.zeros(len(cloud), bool)
    ids = cluster_obstacles(cloud.xyz, ground, params)
    fit_grounded_boxes(cloud.xyz, ground, ids, boxes)
    _warm_up_tree(params)


def warm_up_candidates(params: PipelineParams, segmented: bool = False) -> None:
    """Compile the pipeline, or only the stages after the clustering if `segmented` is True."""
    person = _make_person()
    seed = seed_from_points(person, np.array([8, 0, -0.85, 1, 1, 1.7, 0]))
    cloud = _make_cloud()
    ids = np.arange(len(cloud)) // 200
    columns = dict(ground=ids < 3, cluster_ids=np.maximum(ids - 2, 0)) if segmented else {}
    find_candidates(cloud, make_fixed_source(seed), CAMERA, params, **columns)
    if not segmented:
        _warm_up_tree(params.clustering)


def _warm_up_tree(params: ClusteringParams) -> None:
    """Compile the tree of Euclidean clustering, which is used only for dense clouds."""
    if params.method == "euclidean":
        cluster_euclidean(_make_person(), params.euclidean, -1, 0)


def _make_person() -> np.ndarray:
    """Return random points (400, 3) float32 in the volume of a person."""
    rng = np.random.default_rng(0)
    return (rng.uniform(-0.5, 0.5, (400, 3)) * [0.5, 0.5, 1.7] + [8, 0, -0.8]).astype(np.float32)


def _make_cloud() -> PointCloud:
    """Return a cloud with 600 points on flat ground and 3,000 on objects."""
    rng = np.random.default_rng(0)
    ground = rng.uniform(-20, 20, (600, 3)) * [1, 1, 0.001] - [0, 0, 1.7]
    person = _make_person()
    dense_object = rng.uniform(-0.05, 0.05, (2000, 3)) + [8, 2, 0]  # DBSCAN has a separate code path for it
    split_object = rng.uniform(-0.1, 0.1, (200, 3)) + [15, 0, 0]  # two range bands of DBSCAN meet at 15 m
    xyz = np.concatenate([ground, person, person + [12, 0, 0], dense_object, split_object])
    return PointCloud(xyz.astype(np.float32))

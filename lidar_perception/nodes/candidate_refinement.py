"""Node that finds pedestrian candidates among clusters: ~/input/points -> ~/output/detections."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import refine_segmented
from lidar_perception.candidates.seed_sources import SeedSource
from lidar_perception.candidates.segmented_cloud import SegmentedCloud, fit_grounded_boxes
from lidar_perception.candidates.warm_up import warm_up_candidates
from lidar_perception.intensity import StreamScale
from lidar_perception.nodes.inputs import SeedInput
from lidar_perception.nodes.interfaces import CLOUD
from lidar_perception.nodes.managed import ManagedNode
from lidar_perception.nodes.outputs import CandidateOutputs
from lidar_perception.params import DetectionNodeParams, RefinementNodeParams
from lidar_perception.runs.compiling import lock_compilation
from lidar_perception.types import InputError
from lidar_perception.wire.messages import read_cluster_ids, read_column, to_point_cloud
from msg_utils.stamps import to_ns

INFERRED = 0.0  # maximum intensity that means: infer it from the clouds


class CandidateRefinement(ManagedNode):
    """Fits boxes on the ground, then applies the height filter, STM and CPA.

    The clouds must have the columns `ground` and `cluster_id`.
    """

    def __init__(self, **options: Any):
        super().__init__("candidate_refinement", RefinementNodeParams(), DetectionNodeParams(), **options)

    def configure(self) -> None:
        with lock_compilation(self.get_logger().info):
            warm_up_candidates(PipelineParams(**vars(self.params)), segmented=True)
        self.results = CandidateOutputs(self)
        self.seed = SeedInput(self, self.on_cloud)
        self.scale = StreamScale()
        self.inputs.subscribe("points", CLOUD, self.seed.add_cloud)

    def on_cloud(self, msg: Any, source: SeedSource) -> None:
        with self.diagnostics.measure_frame(to_ns(msg.header.stamp)):
            frame, indices = to_point_cloud(
                msg, INFERRED if self.params.seed.source == "automatic" else None, self.scale
            )
            frame = self.transforms.find_placement(msg.header).level_frame(frame)
            ground, clusters = read_column(msg, "ground", indices), read_cluster_ids(msg, indices)
            if clusters is None:
                raise InputError(
                    "the cloud has no column 'cluster_id'; remap ~/input/points to the output of the clustering"
                )
            ids, numbers = clusters
            ground = np.zeros(len(ids), bool) if ground is None else ground > 0
            segmented_cloud = SegmentedCloud(
                indices,
                frame.xyz,
                ground,
                ids,
                fit_grounded_boxes(frame.xyz, ground, ids, self.params.boxes),
                numbers,
                frame.intensity,
            )
            self.results.publish(msg.header, frame.xyz, lambda: refine_segmented(segmented_cloud, source, self.params))

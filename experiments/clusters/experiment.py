"""The experiment of paper C on one frame, and its report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from experiments.clusters.range_image import RangeImageParams
from experiments.clusters.segmentation import STUDY, measure_segmentation
from experiments.clusters.segmentation_tables import make_segmentation_sections
from experiments.framework.experiment import Experiment, Section
from lidar_perception.clustering.params import ClusteringParams
from lidar_perception.data.frame import Frame
from lidar_perception.data.nuscenes.folder import KeyFrame
from lidar_perception.param_fields import flatten


def measure_frame(frames: Sequence[Frame], number: int) -> dict[str, Any]:
    """Measure frame `number` and return its record, see measure_segmentation()."""
    frame = frames[number]
    data = "nuScenes" if isinstance(frame.native, KeyFrame) else "KITTI"
    return {"frame": frame.name, "data": data, **measure_segmentation(frame)}


def make_sections(records: list[dict[str, Any]]) -> list[Section]:
    """Return the report of the records of measure_frame(); skipped frames are left out."""
    records = [record for record in records if "skipped" not in record]
    data = records[0]["data"] if records else "KITTI"
    return make_segmentation_sections(records, data)


CLUSTERS = Experiment(
    "clusters", "Adaptive clustering and improved PointNet: the tables of the paper",
    "Does a plain reading of the paper's methods give the paper's values?",
    measure_frame, make_sections,
    {"clustering": flatten(ClusteringParams()), "study": asdict(STUDY),
     "range image": asdict(RangeImageParams())})

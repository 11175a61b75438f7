"""The nodes of the network detectors for tests: parameters, weights, invalid clouds, and the
offline detector to compare with. The fixtures are in ros/conftest.py."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pointnet_samples
from detection_samples import lower_thresholds, make_random_network, make_scan, make_tiny_config
from ros_samples import make_ros_cloud

from lidar_perception.detectors.checkpoint import Header, save_checkpoint
from lidar_perception.detectors.fused.detector import load_fused_detector
from lidar_perception.detectors.fused.fusion import load_shipped_models, write_fusion
from lidar_perception.detectors.fused.params import STEPS as FUSED_STEPS
from lidar_perception.detectors.fused.params import FusedDetectorParams
from lidar_perception.detectors.pointnet.detector import load_pointnet_detector
from lidar_perception.detectors.pointnet.params import STEPS as POINTNET_STEPS
from lidar_perception.detectors.pointpillars.detector import STEPS as POINTPILLARS_STEPS
from lidar_perception.detectors.pointpillars.detector import load_detector
from lidar_perception.nodes.graph import build_graph
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.testing.clouds import make_cloud_message
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.messages import to_detections, to_point_cloud
from msg_utils.markers import compute_yaw, from_marker_array, make_box_pose

CONFIG = Path(__file__).resolve().parents[2] / "config"
REMAP = {"~/input/points": "/in", "~/output/detections": "/found"}


@dataclass(frozen=True)
class DetectorUnderTest:
    """A detector node.

    Attributes:
        node: name of the node.
        graph: remappings of the nodes of its graph.
        stages: file with the parameters of the other nodes.
        params: parameters of the detector, with thresholds of 0.
        load: loads the offline detector.
        make_weights: writes random weights that detect something into a folder.
        steps: names of the timed steps.
        title: first words of the network's name in the diagnostics.
        bad_clouds: makes name -> cloud, words of the diagnostic.
    """

    node: str
    graph: Mapping[str, Mapping[str, str]]
    stages: Path
    params: Any
    load: Callable[..., Any]
    make_weights: Callable[[Path], Path]
    steps: tuple[str, ...]
    title: str
    bad_clouds: Callable[[], dict[str, tuple[Any, str]]] = field(repr=False)

    @property
    def between(self) -> str:
        """Topic from which the detector receives clouds."""
        return self.graph[self.node]["~/input/points"]

    @property
    def network(self) -> str:
        """Group of the detector's own parameters."""
        return self.node.removesuffix("_detector")

    def values(self, weights: Path, **changes: Any) -> dict[str, Any]:
        """Return the parameters of the node that are not the defaults.

        The node uses the CPU as `offline` does: a GPU rounds differently.
        """
        params = with_values(
            self.params,
            {
                f"{self.network}.weights": str(weights),
                f"{self.network}.device": "cpu",
                f"{self.network}.threads": 1,
                **changes,
            },
        )
        defaults = flatten(type(self.params)())
        return {k: v for k, v in flatten(params).items() if v != defaults[k]}

    def offline(self, weights: Path, msg: Any, **columns: Any) -> Any:
        """Return the detections of the detector without ROS."""
        detector = self.load(weights, "cpu", with_values(self.params, {f"{self.network}.threads": 1}))
        point_cloud = to_point_cloud(msg, self.params.input.intensity_max)[0]
        return detector(point_cloud, **columns).detections


def small_v4(folder: Path) -> Path:
    """Write random weights of a small v4 that detects something."""
    path = folder / "v4.safetensors"
    save_checkpoint(path, make_random_network(make_tiny_config("v4")), Header(make_tiny_config("v4")))
    return path


def make_scan_message(stamp, **columns):
    """Return the scan of detection_samples with additional columns."""
    return make_cloud_message(np.column_stack([make_scan().xyz, make_scan().intensity]), stamp, **columns)


def find_received(messages, stamp):
    """Return the received detections of the cloud with this stamp, or None."""
    return next((m for m in map(from_marker_array, messages) if m.stamp_ns == stamp), None)


def assert_equal(objects, expected):
    found = to_detections(objects)
    assert len(expected) > 3
    np.testing.assert_array_equal(found.boxes[:, :6], expected.boxes[:, :6])
    yaws = [compute_yaw(make_box_pose(box, make_bag_message)) for box in expected.boxes]  # -pi .. pi
    np.testing.assert_array_equal(found.boxes[:, 6], np.float32(yaws))
    np.testing.assert_array_equal(found.scores, expected.scores)
    np.testing.assert_array_equal(found.class_ids, expected.class_ids)


def small_pointnet(folder: Path) -> Path:
    """Write random weights of a small PointNet that detects something."""
    path = folder / "pointnet.safetensors"
    config = pointnet_samples.make_small_config()
    save_checkpoint(path, pointnet_samples.make_random_network(config), Header(config))
    return path


def small_fusion(folder: Path) -> Path:
    """Write a fused detector of small weights, with curves that differ from the shipped ones."""
    models = {name: {**model, "bias": model["bias"] + 1} for name, model in load_shipped_models().items()}
    write_fusion(folder / "fused.json", (small_v4(folder), None), models, {})
    return folder / "fused.json"


def _pointpillars_clouds():
    xyz, rng = make_scan().xyz, np.random.default_rng(0)
    count = np.zeros(len(xyz))
    return {
        "one point": (make_ros_cloud([[5, 0, -1]]), "no intensity"),
        "out of range": (make_ros_cloud(xyz + [500, 0, 0]), "network's range"),
        "behind": (make_ros_cloud(np.abs(xyz) * [-1, 1, -1] - [1, 0, 0]), "network's range"),
        "no intensity": (make_ros_cloud(xyz), "no intensity"),
        "a million": (make_ros_cloud(rng.uniform(-50, 50, (1_000_000, 3)) * [1, 1, 0.05]), "no intensity"),
        "some NaN": (make_ros_cloud(np.where(np.arange(len(xyz))[:, None] % 3, xyz, np.nan)), "no intensity"),
        "all is ground": (make_scan_message(1, ground=count.astype("u1") + 1), "are ground"),
        "no clusters": (make_scan_message(1, ground=count.astype("u1"), cluster_id=count.astype("u4")), "detecting"),
        "ids beyond int32": (
            make_scan_message(1, cluster_id=(count + 2**32 - 1).astype("u4"), ground=count.astype("u1")),
            "detecting",
        ),
        "large ids": (make_scan_message(1, cluster_id=(count + 2**31 - 1).astype("u4")), "detecting"),
        "float columns": (make_scan_message(1, cluster_id=count * np.nan, ground=count * np.nan), "detecting"),
        "two values per point": (make_scan_message(1, ground=np.zeros((len(xyz), 2), "u1")), "'ground' has count > 1"),
    }


def _pointnet_clouds():
    count = np.zeros(len(make_scan()))
    return {
        "one point": (make_ros_cloud([[5, 0, -1]]), "no clusters"),
        "all is ground": (make_scan_message(1, ground=count.astype("u1") + 1), "no clusters"),
        "no clusters": (make_scan_message(1, cluster_id=count.astype("u4")), "no clusters"),
        "clusters of one point": (
            make_scan_message(1, cluster_id=np.arange(len(count), dtype="u4")),
            "fewer than 3 points",
        ),
        "ids beyond int32": (make_scan_message(1, cluster_id=(count + 2**32 - 1).astype("u4")), "no clusters"),
        "one large cluster": (make_scan_message(1, cluster_id=(count + 2**31 - 1).astype("u4")), "detecting"),
        "float column": (make_scan_message(1, cluster_id=count * np.nan), "no clusters"),
        "no intensity": (make_ros_cloud(make_scan().xyz), "no intensity"),
        "two values per point": (
            make_scan_message(1, cluster_id=np.zeros((len(count), 2), "u4")),
            "'cluster_id' has count > 1",
        ),
    }


def _fused_clouds():
    return {
        "out of range": (make_ros_cloud(make_scan().xyz + [500, 0, 0]), "network's range"),
        "all is ground": (make_scan_message(1, ground=np.ones(len(make_scan()), "u1")), "are ground"),
    }


POINTPILLARS_NODE = DetectorUnderTest(
    "pointpillars_detector",
    build_graph(["pointpillars"]),
    CONFIG / "pointpillars.param.yaml",
    lower_thresholds(),
    load_detector,
    small_v4,
    POINTPILLARS_STEPS,
    "v4 compact",
    _pointpillars_clouds,
)
POINTNET_NODE = DetectorUnderTest(
    "pointnet_detector",
    build_graph(["pointnet"]),
    CONFIG / "pointnet.param.yaml",
    pointnet_samples.accept_every_cluster(),
    load_pointnet_detector,
    small_pointnet,
    POINTNET_STEPS,
    "improved, Car",
    _pointnet_clouds,
)
FUSED_NODE = DetectorUnderTest(
    "fused_detector",
    build_graph(["fused"], single=True),
    CONFIG / "fused.param.yaml",
    with_values(
        FusedDetectorParams(),
        {
            "fused.range": "around",
            **{f"fused.scores.{name}": 0.0 for name in ("car", "pedestrian", "cyclist", "other")},
        },
    ),
    load_fused_detector,
    small_fusion,
    FUSED_STEPS,
    "",
    _fused_clouds,
)

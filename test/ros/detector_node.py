"""What the tests of the detectors' nodes share: the parameters of a small network, the offline
detector beside the node, and clouds to send. The fixtures are in conftest.py."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from detection_samples import frame, lively, tiny

from lidar_perception.detectors.checkpoint import Header, save_checkpoint
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.testing.clouds import make_cloud_message
from lidar_perception.wire.codec import bag_message
from lidar_perception.wire.messages import to_detections, to_point_cloud
from msg_utils.markers import compute_yaw, from_marker_array, make_box_pose

REMAP = {"~/input/points": "/in", "~/output/detections": "/found"}


@dataclass(frozen=True)
class DetectorUnderTest:
    """A node, its graph and the file with the parameters of the others; params and load are those
    of the offline detector."""

    node: str
    graph: Mapping[str, Mapping[str, str]]
    stages: Path
    params: Any
    load: Callable[..., Any]

    @property
    def between(self) -> str:
        """The topic of the clouds that the detector gets."""
        return self.graph[self.node]["~/input/points"]

    @property
    def network(self) -> str:
        """The group of its parameters."""
        return self.node.removesuffix("_detector")

    def values(self, weights: Path, **changes: Any) -> dict[str, Any]:
        """Parameters of the node, as flat as a launch file has them; unchanged ones are left
        out. On the CPU, as `offline`, also where there is a GPU, which rounds in another way."""
        params = with_values(self.params, {f"{self.network}.weights": str(weights),
                                           f"{self.network}.device": "cpu",
                                           f"{self.network}.threads": 1, **changes})
        defaults = flatten(type(self.params)())
        return {k: v for k, v in flatten(params).items() if v != defaults[k]}

    def offline(self, weights: Path, msg: Any, **columns: Any) -> Any:
        """What the detector finds without ROS."""
        detector = self.load(weights, "cpu", with_values(self.params, {
            f"{self.network}.threads": 1}))
        cloud = to_point_cloud(msg, self.params.input.intensity_max)[0]
        return detector(cloud, **columns).detections


def small_v4(folder: Path) -> Path:
    """The file of a small v4 with random weights, which finds something."""
    path = folder / "v4.safetensors"
    save_checkpoint(path, lively(tiny("v4")), Header(tiny("v4")))
    return path


def message(stamp, **columns):
    """The scan of detection_samples, with columns of its own."""
    return make_cloud_message(np.column_stack([frame().xyz, frame().intensity]), stamp, **columns)


def received(messages, stamp):
    """What came for the cloud of a stamp."""
    return next((m for m in map(from_marker_array, messages) if m.stamp_ns == stamp), None)


def assert_equal(objects, expected):
    found = to_detections(objects)
    assert len(expected) > 3
    np.testing.assert_array_equal(found.boxes[:, :6], expected.boxes[:, :6])
    yaws = [compute_yaw(make_box_pose(box, bag_message)) for box in expected.boxes]  # -pi .. pi
    np.testing.assert_array_equal(found.boxes[:, 6], np.float32(yaws))
    np.testing.assert_array_equal(found.scores, expected.scores)
    np.testing.assert_array_equal(found.class_ids, expected.class_ids)

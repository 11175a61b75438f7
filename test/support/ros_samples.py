"""Messages and parameters for tests of nodes: invalid clouds, and the protocol of paper A."""

from __future__ import annotations

import numpy as np

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.param_fields import with_values
from lidar_perception.testing.clouds import make_cloud_message
from lidar_perception.wire.codec import make_bag_message
from msg_utils.point_cloud2 import from_array
from msg_utils.stamps import make_header

PAPER = with_values(PipelineParams(), {"view.enabled": True, "seed.source": "ground_truth"})
CLOUD, MARKERS = "sensor_msgs/msg/PointCloud2", "visualization_msgs/msg/MarkerArray"
XYZ = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])


def make_ros_cloud(xyz, stamp=1, **changes):
    msg = make_cloud_message(xyz, stamp)
    for name, value in changes.items():
        setattr(msg, name, value)
    return msg


def make_cloud_without_x():
    msg = make_ros_cloud(np.ones((5, 3)))
    msg.fields[0].name = "a"
    return msg


def make_cloud_with_integer_z():
    msg = make_ros_cloud(np.ones((5, 3)))
    msg.fields[2].datatype = 5
    return msg


def to_big_endian(xyz, stamp):
    points = np.asarray(xyz, np.float32).view(XYZ).reshape(-1).astype(XYZ.newbyteorder(">"))
    return from_array(points, make_header(stamp, "lidar", make_bag_message), make_bag_message)


BAD = {  # defect -> message, words of the diagnostic
    "empty": (make_ros_cloud(np.zeros((0, 3))), "no finite point"),
    "missing x": (make_cloud_without_x(), "no field 'x'"),
    "no fields at all": (make_bag_message(CLOUD), "no field 'x'"),
    "all NaN": (make_ros_cloud(np.full((9, 3), np.nan)), "no finite point"),
    "cut": (make_ros_cloud(np.ones((5, 3)), data=np.zeros(7, np.uint8)), "7 bytes"),
    "all infinite": (make_ros_cloud(np.full((9, 3), np.inf)), "no finite point"),
    "integer z": (make_cloud_with_integer_z(), "'z'"),
    "more points than bytes": (make_ros_cloud(np.ones((5, 3)), width=2**31), "bytes"),
    "point_step 0": (make_ros_cloud(np.ones((5, 3)), point_step=0), "point_step"),
    "one point": (make_ros_cloud([[5, 0, -1]]), "no ground"),
}


QUIET = {"input.queue": 5, "input.min_rate": 0.0, "input.error_after": 1e6, "input.stale_after": 1e6}

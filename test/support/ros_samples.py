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


def cloud(xyz, stamp=1, **changes):
    msg = make_cloud_message(xyz, stamp)
    for name, value in changes.items():
        setattr(msg, name, value)
    return msg


def make_cloud_without_x():
    msg = cloud(np.ones((5, 3)))
    msg.fields[0].name = "a"
    return msg


def make_cloud_with_integer_z():
    msg = cloud(np.ones((5, 3)))
    msg.fields[2].datatype = 5
    return msg


def big_endian(xyz, stamp):
    points = np.asarray(xyz, np.float32).view(XYZ).reshape(-1).astype(XYZ.newbyteorder(">"))
    return from_array(points, make_header(stamp, "lidar", make_bag_message), make_bag_message)


BAD = {  # defect -> message, words of the diagnostic
    "empty": (cloud(np.zeros((0, 3))), "no finite point"),
    "missing x": (make_cloud_without_x(), "no field 'x'"),
    "no fields at all": (make_bag_message(CLOUD), "no field 'x'"),
    "all NaN": (cloud(np.full((9, 3), np.nan)), "no finite point"),
    "cut": (cloud(np.ones((5, 3)), data=np.zeros(7, np.uint8)), "7 bytes"),
    "all infinite": (cloud(np.full((9, 3), np.inf)), "no finite point"),
    "integer z": (make_cloud_with_integer_z(), "'z'"),
    "more points than bytes": (cloud(np.ones((5, 3)), width=2**31), "bytes"),
    "point_step 0": (cloud(np.ones((5, 3)), point_step=0), "point_step"),
    "one point": (cloud([[5, 0, -1]]), "no ground"),
}


QUIET = {"input.queue": 5, "input.min_rate": 0.0, "input.error_after": 1e6, "input.stale_after": 1e6}

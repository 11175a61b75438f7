"""Messages of a robot with tilted sensors, frames and odometry, for nodes in the test process."""

from __future__ import annotations

import numpy as np
from robot_bags import make_tf_message, make_transform
from samples import WALKER
from samples import make_scene as walker_scene
from scipy.spatial.transform import Rotation

from lidar_perception.robot.poses import invert_pose, transform_points
from lidar_perception.wire.codec import encode, make_bag_message
from msg_utils.point_cloud2 import from_array
from msg_utils.stamps import make_header

START = 1_700_000_000 * 10**9
PERIOD = 10**8
WALKING = {"seed.source": "click", "clustering.dbscan.eps": (0.5, 0.5, 0.5)}


def deliver_cloud(node, msg):
    """Deliver a cloud as the middleware does."""
    node.inputs.receptions[0].deliver(encode(msg), False)


def make_robot_cloud(xyz, stamp=START, intensity=None, frame_id="lidar", **columns):
    kinds = [*((n, "<f4") for n in ("x", "y", "z", "intensity")), *((k, v.dtype.str) for k, v in columns.items())]
    points = np.zeros(len(xyz), kinds)
    points["x"], points["y"], points["z"] = np.asarray(xyz, np.float32).T
    points["intensity"] = 0.3 if intensity is None else intensity
    for name, values in columns.items():
        points[name] = values
    return from_array(points, make_header(stamp, frame_id, make_bag_message), make_bag_message)


def transforms(*rows):
    """Return a tf2_msgs/TFMessage of rows (parent, child, pose (4, 4), stamp)."""
    return make_tf_message(*(make_transform(parent, child, stamp, pose) for parent, child, pose, stamp in rows))


def make_base_odometry(pose, stamp, child="base", frame="odom"):
    t, q = pose[:3, 3].tolist(), Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    found = make_bag_message(
        "nav_msgs/msg/Odometry", child_frame_id=child, header=make_header(stamp, frame, make_bag_message)
    )
    for name, value in zip("xyz", t):
        setattr(found.pose.pose.position, name, value)
    for name, value in zip("xyzw", q):
        setattr(found.pose.pose.orientation, name, value)
    return found


def mount_pose(x, y, height, yaw, pitch, roll):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    pose[:3, 3] = x, y, height
    return pose


def list_problems(node):
    return " ".join(p[2] for p in node.diagnostics.find_problems())


def make_walker(base):
    """Return walker_scene() on the floor of the base, in the frame of a sensor at pose `base`, and
    the position of its person in the base."""
    on_floor = walker_scene()[:, :3].astype(np.float64) + [0, 0, 1.7]
    return transform_points(on_floor, invert_pose(base)), WALKER[:3] + [0, 0, 1.7]

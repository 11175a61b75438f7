"""TF and odometry in a tree of frames."""

from __future__ import annotations

from typing import Any

from lidar_perception.robot.tree import TransformTree
from lidar_perception.types import InputError
from msg_utils.stamps import to_ns

TF_MESSAGE, ODOMETRY_MESSAGE = "tf2_msgs/msg/TFMessage", "nav_msgs/msg/Odometry"
# The frames of the odometry, by the fields of the message and not by what these hold: both may hold
# the same, or nothing.
MOVING, STILL = "child_frame_id", "header.frame_id"


def add_transforms(tree: TransformTree, msg: Any, static: bool) -> None:
    """Add those of a tf2_msgs/TFMessage to a tree. InputError at the end where one of them is no
    transform, which is left out."""
    wrong = None
    for each in msg.transforms:
        t, q = each.transform.translation, each.transform.rotation
        try:
            tree.set(each.header.frame_id, each.child_frame_id, to_ns(each.header.stamp),
                     (t.x, t.y, t.z), (q.x, q.y, q.z, q.w), static)
        except InputError as error:
            wrong = error
    if wrong is not None:
        raise wrong


def add_odometry(tree: TransformTree, msg: Any) -> None:
    """Add a nav_msgs/Odometry to a tree of its own: where MOVING is in STILL at its stamp.
    InputError where it is no pose."""
    p, q = msg.pose.pose.position, msg.pose.pose.orientation
    tree.set(STILL, MOVING, to_ns(msg.header.stamp), (p.x, p.y, p.z), (q.x, q.y, q.z, q.w))

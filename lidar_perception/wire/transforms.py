"""Functions that add TF and odometry messages to a transform tree."""

from __future__ import annotations

from typing import Any

from lidar_perception.robot.transform_tree import TransformTree
from lidar_perception.types import InputError
from msg_utils.stamps import to_ns

TF_MESSAGE, ODOMETRY_MESSAGE = "tf2_msgs/msg/TFMessage", "nav_msgs/msg/Odometry"
# Frame names in a tree of odometry poses: the names of the message fields, because the frame names in the
# messages may be equal or empty.
MOVING, FIXED = "child_frame_id", "header.frame_id"


def add_transforms(tree: TransformTree, msg: Any, static: bool) -> None:
    """Add the valid transforms of a tf2_msgs/TFMessage.

    Raises:
        InputError: A transform is invalid; all valid ones are added.
    """
    problem = None
    for stamped in msg.transforms:
        t, q = stamped.transform.translation, stamped.transform.rotation
        try:
            tree.set(
                stamped.header.frame_id,
                stamped.child_frame_id,
                to_ns(stamped.header.stamp),
                (t.x, t.y, t.z),
                (q.x, q.y, q.z, q.w),
                static,
            )
        except InputError as error:
            problem = error
    if problem is not None:
        raise problem


def add_odometry(tree: TransformTree, msg: Any) -> None:
    """Add the pose of a nav_msgs/Odometry to a separate tree, as the pose of MOVING in FIXED.

    Raises:
        InputError: The pose is invalid.
    """
    p, q = msg.pose.pose.position, msg.pose.pose.orientation
    tree.set(FIXED, MOVING, to_ns(msg.header.stamp), (p.x, p.y, p.z), (q.x, q.y, q.z, q.w))

"""Bags of robots: odometry of the base at its own rate, and TF."""

import numpy as np
from scipy.spatial.transform import Rotation

from lidar_perception.data.bag import BagWriter
from lidar_perception.data.frame import POSES
from lidar_perception.data.open import open_recording
from lidar_perception.robot.placement import make_tilted_pose
from lidar_perception.robot.poses import make_pose
from lidar_perception.testing.clouds import make_cloud_message
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.messages import make_odometry
from lidar_perception.wire.topics import POINTS, TF, TF_STATIC
from lidar_perception.wire.transforms import ODOMETRY_MESSAGE, TF_MESSAGE
from msg_utils.stamps import SECOND_NS, make_header

START, CLOUDS = 1_700_000_000 * SECOND_NS, 5
ON_BASE = make_tilted_pose(0.02, -0.05, 1.1)  # pose of the sensor in base_link
ON_BASE[:3, :3] = ON_BASE[:3, :3] @ Rotation.from_euler("z", 90, degrees=True).as_matrix()
ON_BASE[0, 3] = 0.4


def compute_base_pose(stamp):
    """Return the pose of the base in odom, on a curve."""
    t = (stamp - START) / SECOND_NS
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", 0.3 * t).as_matrix()
    pose[:3, 3] = 5 * t, 0.7 * t, 0
    return pose


def list_stamps():
    """Return the stamps of the clouds, which are between those of the odometry."""
    return [START + round((0.1 * i + 0.003) * SECOND_NS) for i in range(CLOUDS)]


def make_transform(parent, child, stamp, pose):
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return make_bag_message(
        "geometry_msgs/msg/TransformStamped",
        child_frame_id=child,
        header=make_header(stamp, parent, make_bag_message),
        transform=make_bag_message(
            "geometry_msgs/msg/Transform",
            translation=make_bag_message("geometry_msgs/msg/Vector3", **dict(zip("xyz", pose[:3, 3]))),
            rotation=make_bag_message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        ),
    )


def make_tf_message(*transforms):
    return make_bag_message(TF_MESSAGE, transforms=list(transforms))


def make_odometry_rows(topic, child="base_link", seconds=CLOUDS / 10):
    """Yield odometry every 20 ms."""
    for i in range(-2, round(50 * seconds) + 1):
        stamp = START + i * SECOND_NS // 50
        yield (
            topic,
            ODOMETRY_MESSAGE,
            stamp,
            make_odometry(
                compute_base_pose(stamp), make_header(stamp, "odom", make_bag_message), child, make_bag_message
            ),
        )


def make_tf_rows(seconds=CLOUDS / 10):
    """Yield map -> odom -> base_link every 20 ms; the map frame jumps."""
    for i in range(-2, round(50 * seconds) + 1):
        stamp = START + i * SECOND_NS // 50
        jump = make_tilted_pose(0, 0, i % 2)
        yield (
            TF,
            TF_MESSAGE,
            stamp,
            make_tf_message(
                make_transform("map", "odom", stamp, jump),
                make_transform("odom", "base_link", stamp, compute_base_pose(stamp)),
            ),
        )


def make_mount_rows(parent="base_link", pose=ON_BASE):
    yield (
        TF_STATIC,
        TF_MESSAGE,
        START,
        make_tf_message(make_transform(parent, "plate", 0, np.eye(4)), make_transform("plate", "/lidar", 0, pose)),
    )


def make_point_cloud(stamp):
    """Return a cloud of one point."""
    return make_cloud_message(np.ones((3, 4)), stamp, "lidar")


def write_robot_bag(path, *parts, cloud=make_point_cloud):
    """Write a bag of clouds in the frame lidar and the given messages; return the recording."""
    messages = [message for part in parts for message in part]
    messages += [(POINTS, "sensor_msgs/msg/PointCloud2", stamp, cloud(stamp)) for stamp in list_stamps()]
    with BagWriter(path) as bag:
        for topic, kind in dict.fromkeys((topic, kind) for topic, kind, *_ in messages):
            bag.add_topic(topic, kind)
        for topic, _, stamp, message in sorted(messages, key=lambda m: m[2]):
            bag.write(topic, stamp, message)
    return open_recording(path)


def check_poses(recording, on_base=ON_BASE):
    """Assert that the poses are those of the base and the mount."""
    assert POSES in recording.contents
    for frame, stamp in zip(recording, list_stamps(), strict=True):
        np.testing.assert_allclose(frame.pose(), compute_base_pose(stamp) @ on_base, atol=1e-4)


def read_pose(pose):
    """Return a geometry_msgs/Pose as matrix (4, 4)."""
    p, q = pose.position, pose.orientation
    return make_pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))

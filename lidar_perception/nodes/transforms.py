"""TF and odometry for a node: mounting and motion of the sensor, and the output frame.

The package has its own transform tree, so that nodes behave the same with and without tf2_ros.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import replace
from math import inf
from time import monotonic, perf_counter
from typing import Any

import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.nodes.diagnostics import WARN, Problem
from lidar_perception.robot.crop import crop_frame
from lidar_perception.robot.params import CropParams
from lidar_perception.robot.placement import Placement, find_level_transform, make_tilted_pose
from lidar_perception.robot.poses import invert_pose
from lidar_perception.robot.transform_tree import MissingTransform, TransformTree
from lidar_perception.types import InputError, PointCloud
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.messages import to_point_cloud
from lidar_perception.wire.point_times import deskew_points, read_point_times, replace_points
from lidar_perception.wire.topics import TF, TF_STATIC
from lidar_perception.wire.transforms import FIXED, MOVING, ODOMETRY_MESSAGE, TF_MESSAGE, add_odometry, add_transforms
from msg_utils.stamps import SECOND_NS, to_ns

TF_QOS = QoSProfile(depth=100)
STATIC_QOS = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
ODOMETRY_QOS = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)  # best effort matches every publisher
ODOMETRY_TIMEOUT_S = 2.0  # silence after which odometry in another frame is accepted
NO_TF = "TF is not available because tf2_msgs is not installed; install the ROS 2 package tf2_msgs"


def has_tf() -> bool:
    """Return True if tf2_msgs is installed; the ROS wheels on PyPI do not include it."""
    return importlib.util.find_spec("tf2_msgs") is not None


class Transforms:
    """Transforms that the parameters base_frame, target_frame and input of a node require.

    If TF lacks one of these frames, a fallback is used and a diagnostic names the frame.
    """

    def __init__(self, node: Any):
        self.node, params = node, node.node_params
        self.tree, self.odometry = TransformTree(), TransformTree()
        self.base_frame = params.base_frame.lstrip("/")
        self.target_frame = getattr(params, "target_frame", "").lstrip("/")
        self.odometry_child = self.odometry_frame = ""  # child frame and parent frame of the odometry
        self.odometry_ns: int | None = None  # stamp of the last odometry message
        self.odometry_arrival = self.ignored_arrival = -inf  # monotonic times of arrival
        # Functions that describe the data that a cloud with this header still needs, or return None.
        self.other_checks: list[Callable[[Any], str | None]] = []
        self.sweep_duration: float | None = None  # time from the stamp to the last point of a cloud, in seconds
        self.problem_by_source: dict[str, str] = {}  # parameter that causes the problem -> message
        self.diagnostic_values: dict[str, Any] = {}
        self._cached_placement: tuple[tuple[str, int], Placement] = (("", -1), Placement(""))
        self._connected_pairs: set[tuple[str, str]] = set()  # pairs of frames that TF has connected before
        self._has_tf_subscription = self._has_odometry_subscription = False
        self._has_tf = has_tf()
        if self._has_tf:
            self._subscribe(TF_STATIC, STATIC_QOS, static=True)
        if self.base_frame or self.target_frame or params.input.deskew == "tf":
            self.subscribe_to_tf()
            if not self._has_tf:
                self.problem_by_source["TF"] = NO_TF
        if params.input.deskew == "odometry":
            self.subscribe_to_odometry()

    @property
    def is_used(self) -> bool:
        """True if a parameter of the node requires TF or odometry."""
        return bool(self.base_frame or self.target_frame or self.node.node_params.input.deskew != "off")

    def subscribe_to_tf(self) -> None:
        """Subscribe to /tf, in addition to /tf_static, unless already subscribed."""
        if self._has_tf_subscription:
            return
        self._has_tf_subscription = True
        if self._has_tf:
            self._subscribe(TF, TF_QOS, static=False)

    def subscribe_to_odometry(self) -> None:
        """Subscribe to the odometry unless already subscribed."""
        if not self._has_odometry_subscription:
            self._has_odometry_subscription = True
            self.node.inputs.subscribe("odometry", ODOMETRY_MESSAGE, self.on_odometry, ODOMETRY_QOS)

    def _subscribe(self, topic: str, qos: QoSProfile, static: bool) -> None:
        self.node.inputs.subscribe(topic, TF_MESSAGE, lambda m: self.on_tf(m, static), qos, private=False)

    def on_tf(self, msg: Any, static: bool) -> None:
        """Add a tf2_msgs/TFMessage to the tree. Invalid transforms are reported and not added."""
        try:
            add_transforms(self.tree, msg, static)
        finally:
            self._clear_cache()

    def on_odometry(self, msg: Any) -> None:
        """Add a nav_msgs/Odometry.

        If sources with different frames share the topic, only the first one is used until it stops.
        """
        now, child, frame = monotonic(), msg.child_frame_id.lstrip("/"), msg.header.frame_id.lstrip("/")
        if (child, frame) != (self.odometry_child, self.odometry_frame):
            if now - self.odometry_arrival < ODOMETRY_TIMEOUT_S:
                self.ignored_arrival = now
                self.problem_by_source["odometry"] = (
                    f"two odometry sources on {self.node.resolve_topic_name('~/input/odometry')}: the poses "
                    f"of '{child}' in '{frame}' are ignored, those of '{self.odometry_child}' in "
                    f"'{self.odometry_frame}' are used; publish them on separate topics"
                )
                return
            self.odometry = TransformTree()
        add_odometry(self.odometry, msg)
        if now - self.ignored_arrival > ODOMETRY_TIMEOUT_S:
            self.problem_by_source.pop("odometry", None)
        self.odometry_child, self.odometry_frame, self.odometry_arrival = child, frame, now
        self.odometry_ns = self.node.diagnostics.counts["last_pose_ns"] = to_ns(msg.header.stamp)
        self._clear_cache()

    def _clear_cache(self) -> None:
        self._cached_placement = (("", -1), Placement(""))

    # Inputs that a cloud needs

    def find_missing_input(self, cloud: Any) -> str | None:
        """Return a description of the data that a cloud should wait for, or None."""
        return self._find_missing_frame(cloud) or next(
            filter(None, (find_missing(cloud.header) for find_missing in self.other_checks)), None
        )

    def _find_missing_frame(self, cloud: Any) -> str | None:
        if not self.is_used:
            return None
        frame_id, stamp = cloud.header.frame_id, to_ns(cloud.header.stamp)
        try:
            for frame in filter(None, (self.base_frame, self.target_frame)):
                self._require_connection(frame, frame_id, stamp)
            if self.node.node_params.input.deskew != "off":
                end = stamp + round(self._estimate_sweep_duration(cloud) * SECOND_NS)
                self.look_up_sensor_poses(self.node.node_params.input.deskew, frame_id, np.array([end]))
        except MissingTransform as error:
            return str(error) if error.late else None
        return None

    def _require_connection(self, frame: str, frame_id: str, stamp: int) -> None:
        """Raise MissingTransform if the frames are not connected.

        The error is marked as late if they have never been connected, because the clouds of a
        driver may arrive before the transforms of robot_state_publisher.
        """
        try:
            self.tree.lookup(frame, frame_id, stamp)
        except MissingTransform as error:
            is_first = (frame, frame_id) not in self._connected_pairs and "TF" not in self.problem_by_source
            raise MissingTransform(str(error), error.late or is_first) from None
        self._connected_pairs.add((frame, frame_id))

    def _estimate_sweep_duration(self, cloud: Any) -> float:
        """Return the time from the stamp to the last point of a cloud, in seconds.

        Uses the duration of the last deskewed cloud; until a cloud has been deskewed, the duration of this one.
        """
        if self.sweep_duration is None:
            try:
                seconds = read_point_times(cloud, to_point_cloud(cloud)[1]).seconds
            except InputError:  # reported by deskew_cloud()
                return 0.0
            self.sweep_duration = float(seconds[np.isfinite(seconds)].max(initial=0.0))
        return self.sweep_duration

    def find_placement(self, header: Any) -> Placement:
        """Return the placement of a cloud with this header."""
        key = header.frame_id, to_ns(header.stamp)
        if not (self.base_frame or self.target_frame or self.node.node_params.input.ahead):
            return Placement(header.frame_id)
        if self._cached_placement[0] != key:
            self._cached_placement = key, self._compute_placement(*key)
        return self._cached_placement[1]

    def _compute_placement(self, frame_id: str, stamp_ns: int) -> Placement:
        base = self._look_up("base_frame", self.base_frame, frame_id, stamp_ns)
        if base is not None and not 0.0 <= base[2, 3] <= 50.0:
            self.problem_by_source["base_frame"] = (
                f"'{frame_id}' is {base[2, 3]:.2f} m above '{self.base_frame}', which must be on "
                "the ground (like base_footprint); using ground.sensor_pose"
            )
            base = None
        forward_yaw = np.radians(self.node.node_params.input.ahead)
        sensor_pose = base
        if sensor_pose is None and forward_yaw:  # the yaw rotation follows levelling, so both are applied here
            sensor_pose = self._make_configured_pose()
            sensor_pose = np.eye(4) if sensor_pose is None else sensor_pose
        level = None if sensor_pose is None else find_level_transform(sensor_pose, forward_yaw)
        target = self._look_up("target_frame", self.target_frame, frame_id, stamp_ns)
        if target is None:
            return Placement(frame_id, base, level, None if level is None else invert_pose(level))
        return Placement(self.target_frame, base, level, target if level is None else target @ invert_pose(level))

    def _look_up(self, parameter: str, frame: str, frame_id: str, stamp_ns: int) -> np.ndarray | None:
        """Return the pose of frame_id in `frame`, the value of this parameter; None, with a problem, if unknown."""
        self.problem_by_source.pop(parameter, None)
        if not frame:
            return None
        try:
            return self.tree.lookup(frame, frame_id, stamp_ns)
        except MissingTransform as error:
            fallback = {"base_frame": "using ground.sensor_pose", "target_frame": f"results are in '{frame_id}'"}
            self.problem_by_source[parameter] = f"{parameter} '{frame}': {error}; {fallback[parameter]}"
            return None

    def with_mounting(self, params: Any, placement: Placement) -> Any:
        """Return the parameters of a node for clouds in the level frame of a placement.

        The sensor height comes from TF, or from params.ground.sensor_pose if TF does not provide it.
        """
        height = params.ground.sensor_pose.height
        if placement.base is not None:
            height = float(placement.base[2, 3])
            self.diagnostic_values["mount"] = f"{height:.3f} m above '{self.base_frame}'"
        if placement.base is not None or placement.level is not None:
            params = replace(params, ground=replace(params.ground, sensor_pose=SensorPoseParams(height=height)))
        return params

    def crop_frame(self, frame: PointCloud, crop: CropParams, placement: Placement) -> tuple[np.ndarray, PointCloud]:
        """Crop a frame, see robot.crop.crop_frame.

        The robot's body is not removed while TF has no transform to base_frame.
        """
        self.problem_by_source.pop("crop.body", None)
        if crop.body and self.base_frame:
            if placement.base is None:
                self.problem_by_source["crop.body"] = "crop.body is not applied: the pose in base_frame is unknown"
                crop = replace(crop, body=())
            elif crop.body[5] <= 0.0:
                self.problem_by_source["crop.body"] = (
                    f"the top of crop.body is {-crop.body[5]:.2f} m below '{self.base_frame}'; specify the box in "
                    "that frame, as `setup` does in its parameter file"
                )
        level = placement.level
        pose = None if placement.base is not None else self._make_configured_pose()
        if level is None and pose is not None:
            level = find_level_transform(pose)
        return crop_frame(frame, crop, placement.base, level)

    def to_level(self, header: Any, frame_id: str) -> np.ndarray:
        """Return the (4, 4) transform from a frame to the level frame of the cloud with this header.

        Raises:
            MissingTransform: TF does not connect the frames.
        """
        if frame_id not in ("", header.frame_id):
            self.subscribe_to_tf()
        pose = self.tree.lookup(header.frame_id, frame_id or header.frame_id, to_ns(header.stamp))
        level = self.find_placement(header).level
        return pose if level is None else level @ pose

    # Motion of the sensor

    def look_up_sensor_poses(
        self, source: str, frame_id: str, at: np.ndarray, max_gap: float | None = None
    ) -> np.ndarray:
        """Return the poses of a frame of the robot in a fixed frame.

        Args:
            source: "odometry", or "tf" for poses in input.fixed_frame.
            frame_id: frame of the robot.
            at: (M,) times in ns.
            max_gap: see TransformTree.lookup_many.

        Returns:
            (M, 4, 4) poses.

        Raises:
            MissingTransform: the poses are not available.
        """
        if source == "tf":
            fixed_frame = self.node.node_params.input.fixed_frame
            return self.tree.lookup_many(fixed_frame, frame_id, at, max_gap)
        if frame_id.lstrip("/") == self.odometry_frame != "":  # the sensor does not move in its own odometry frame
            return np.tile(np.eye(4), (len(at), 1, 1))
        return self.look_up_odometry_poses(at, max_gap) @ self._find_child_poses(frame_id, at, max_gap)

    def look_up_odometry_poses(self, at: np.ndarray, max_gap: float | None = None) -> np.ndarray:
        """Return the (M, 4, 4) poses of the child frame of the odometry at times (M,) ns, or raise MissingTransform."""
        if self.odometry_ns is None:
            topic = self.node.resolve_topic_name("~/input/odometry")
            raise MissingTransform(f"no odometry on {topic}; remap it to the topic of the odometry")
        try:
            return self.odometry.lookup_many(FIXED, MOVING, at, max_gap)
        except MissingTransform as error:
            reason = str(error).replace(FIXED, self.odometry_frame)
            reason = reason.replace(MOVING, self.odometry_child)
            raise MissingTransform(
                f"{self.node.resolve_topic_name('~/input/odometry')}: {reason}", error.late
            ) from None

    def _find_child_poses(self, frame_id: str, at: np.ndarray, max_gap: float | None) -> np.ndarray:
        """Return the (M or 1, 4, 4) poses of a frame in the child frame of the odometry."""
        if frame_id.lstrip("/") == self.odometry_child:
            return np.eye(4)[None]
        if not self.odometry_child:
            topic = self.node.resolve_topic_name("~/input/odometry")
            raise MissingTransform(f"the odometry on {topic} has an empty child_frame_id; set it in the publisher")
        try:
            return self.tree.lookup_many(self.odometry_child, frame_id, at, max_gap)
        except MissingTransform as error:
            self.subscribe_to_tf()
            pose = self._make_configured_pose() if self.odometry_child == self.base_frame else None
            if pose is None:
                raise MissingTransform(f"the odometry is for '{self.odometry_child}': {error}", error.late) from None
            return pose[None]

    def is_connected_to_odometry(self, frame_id: str) -> bool:
        """Return True if TF connects a frame with the odometry, or it is a frame of the odometry."""
        if frame_id.lstrip("/") in (self.odometry_child, self.odometry_frame):
            return True
        try:
            self._find_child_poses(frame_id, np.array([self.odometry_ns]), None)
        except MissingTransform as error:
            return error.late
        return True

    def _make_configured_pose(self) -> np.ndarray | None:
        """Return the pose of the sensor above the ground from ground.sensor_pose, or None."""
        ground = getattr(self.node.params, "ground", None)
        pose = ground and ground.sensor_pose
        return None if pose is None else make_tilted_pose(pose.roll, pose.pitch, pose.height)

    def deskew_cloud(self, msg: Any) -> Any:
        """Return the cloud with its points motion-compensated to its stamp.

        Points that the crop removes, such as those on the robot's body, are not moved. Without poses
        or point times, the cloud itself is returned and counted as not deskewed.
        """
        if self.node.node_params.input.deskew == "off":
            return msg
        begin, counts = perf_counter(), self.node.diagnostics.counts
        self.problem_by_source.pop("deskew", None)
        try:
            deskewed_cloud = self._deskew_points(msg)
        except InputError as error:
            self.problem_by_source["deskew"] = f"input.deskew: {error}; clouds are not deskewed"
            counts["not_deskewed"] = counts.get("not_deskewed", 0) + 1
            return msg
        counts["deskewed"] = counts.get("deskewed", 0) + 1
        self.diagnostic_values["deskew_ms"] = f"{(perf_counter() - begin) * 1e3:.1f}"
        return deskewed_cloud

    def _deskew_points(self, msg: Any) -> Any:
        frame, indices = to_point_cloud(msg)
        crop = getattr(self.node.params, "crop", None)
        if crop is not None and crop.enabled:
            cropped_indices, frame = self.crop_frame(frame, crop, self.find_placement(msg.header))
            indices = indices.take(cropped_indices)

        def look_up_poses(at: np.ndarray) -> np.ndarray:
            # Set before the lookup: after a failure, the next cloud waits for the end of its sweep.
            self.sweep_duration = float(at.max() - frame.stamp_ns) / SECOND_NS
            return self.look_up_sensor_poses(self.node.node_params.input.deskew, frame.frame_id, at)

        result = deskew_points(msg, frame, indices, look_up_poses)
        if result is None:
            return msg
        timed_indices, xyz, times = result
        return replace_points(msg, make_bag_message, indices.take(timed_indices), xyz, times)

    # Diagnostics

    def values(self) -> dict[str, Any]:
        """Return the values for the diagnostics."""
        return self.diagnostic_values

    def problems(self) -> list[Problem]:
        """Return the present problems, each with its fallback or remedy."""
        return [(kind, WARN, message) for kind, message in self.problem_by_source.items()]

"""TF and odometry as a node needs them: how its sensor is mounted, where results go, how it moves.

The tree is our own, over /tf and /tf_static, so that it is the same with and without tf2_ros.
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
from lidar_perception.nodes.reception import WARN, Problem
from lidar_perception.robot.crop import crop_frame
from lidar_perception.robot.params import CropParams
from lidar_perception.robot.placement import Placement, find_level_transform, make_tilted_pose
from lidar_perception.robot.poses import invert_pose
from lidar_perception.robot.transform_tree import MissingTransform, TransformTree
from lidar_perception.types import InputError, LidarFrame
from lidar_perception.wire.codec import bag_message
from lidar_perception.wire.messages import to_frame
from lidar_perception.wire.point_times import deskew_points, read_point_times, replace_points
from lidar_perception.wire.topics import TF, TF_STATIC
from lidar_perception.wire.transforms import (
    FIXED,
    MOVING,
    ODOMETRY_MESSAGE,
    TF_MESSAGE,
    add_odometry,
    add_transforms,
)
from msg_utils.stamps import SECOND, to_ns

TF_QOS = QoSProfile(depth=100)
STATIC_QOS = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
ODOMETRY_QOS = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)  # takes any
ALONE = 2.0  # seconds without an odometry, from which on another one may take its place
NO_TF = "tf2_msgs is not installed, so nothing is known of TF; install ROS 2's tf2_msgs"


def has_tf() -> bool:
    """Whether TF can be listened to: the wheels of ROS lack its messages."""
    return importlib.util.find_spec("tf2_msgs") is not None


class Transforms:
    """The frames that a node with the parameters `robot` (base_frame, target_frame, input) asks
    for. Where TF lacks one the parameters stand, and a diagnostic names the frames."""

    def __init__(self, node: Any):
        self.node, robot = node, node.robot
        self.tree, self.odometry = TransformTree(), TransformTree()
        self.base_frame = robot.base_frame.lstrip("/")
        self.target_frame = getattr(robot, "target_frame", "").lstrip("/")
        self.carrier = self.odometry_frame = ""  # what the odometry is of, and in which frame
        self.odometry_ns: int | None = None  # the stamp of the last one
        self.odometry_came = self.left_out = -inf  # monotonic, when it, or another one, came
        self.needs: list[Callable[[Any], str | None]] = []  # of a header: what else it waits for
        self.sweep: float | None = None  # seconds from the stamp to the last point of a cloud
        self.lacking: dict[str, str] = {}  # what asked for it -> what is not there
        self.known: dict[str, Any] = {}  # for the diagnostics
        self._last: tuple[tuple[str, int], Placement] = (("", -1), Placement(""))
        self._met: set[tuple[str, str]] = set()  # frames that have been connected
        self._listening = self._hearing = False
        self._installed = has_tf()
        if self._installed:
            self._subscribe(TF_STATIC, STATIC_QOS, static=True)
        if self.base_frame or self.target_frame or robot.input.deskew == "tf":
            self.listen()
            if not self._installed:
                self.lacking["TF"] = NO_TF
        if robot.input.deskew == "odometry":
            self.hear_odometry()

    @property
    def in_use(self) -> bool:
        """Whether a cloud's frame matters to the node at all."""
        return bool(self.base_frame or self.target_frame
                    or self.node.robot.input.deskew != "off")

    def listen(self) -> None:
        """Subscribe to what moves, too; once."""
        if self._listening:
            return
        self._listening = True
        if self._installed:
            self._subscribe(TF, TF_QOS, static=False)

    def hear_odometry(self) -> None:
        """Subscribe to the odometry; once."""
        if not self._hearing:
            self._hearing = True
            self.node.input("odometry", ODOMETRY_MESSAGE, self.on_odometry, ODOMETRY_QOS)

    def _subscribe(self, topic: str, qos: QoSProfile, static: bool) -> None:
        self.node.input(topic, TF_MESSAGE, lambda m: self.on_tf(m, static), qos,
                        private=False)

    def on_tf(self, msg: Any, static: bool) -> None:
        """A tf2_msgs/TFMessage; what is no transform in it is left out and named."""
        try:
            add_transforms(self.tree, msg, static)
        finally:
            self._changed()

    def on_odometry(self, msg: Any) -> None:
        """A nav_msgs/Odometry: where its child frame is at its stamp. Where several, in frames that
        differ, share the topic, the first one counts as long as it comes."""
        now, child, frame = (monotonic(), msg.child_frame_id.lstrip("/"),
                             msg.header.frame_id.lstrip("/"))
        if (child, frame) != (self.carrier, self.odometry_frame):
            if now - self.odometry_came < ALONE:
                self.left_out = now
                self.lacking["odometry"] = (
                    f"two odometries on {self.node.resolve_topic_name('~/input/odometry')}: that "
                    f"of '{child}' in '{frame}' is left out, that of '{self.carrier}' in "
                    f"'{self.odometry_frame}' is used; give each a topic of its own")
                return
            self.odometry = TransformTree()
        add_odometry(self.odometry, msg)
        if now - self.left_out > ALONE:
            self.lacking.pop("odometry", None)
        self.carrier, self.odometry_frame, self.odometry_came = child, frame, now
        self.odometry_ns = self.node.counts["last_pose_ns"] = to_ns(msg.header.stamp)
        self._changed()

    def _changed(self) -> None:
        self._last = (("", -1), Placement(""))

    # What a cloud needs

    def missing(self, cloud: Any) -> str | None:
        """What a cloud waits for, as it may still come; None if nothing."""
        return self._missing_frame(cloud) or next(
            filter(None, (need(cloud.header) for need in self.needs)), None)

    def _missing_frame(self, cloud: Any) -> str | None:
        if not self.in_use:
            return None
        frame_id, stamp = cloud.header.frame_id, to_ns(cloud.header.stamp)
        try:
            for frame in filter(None, (self.base_frame, self.target_frame)):
                self._meet(frame, frame_id, stamp)
            if self.node.robot.input.deskew != "off":
                self.sensor_poses(self.node.robot.input.deskew, frame_id,
                                  np.array([stamp + round(self._sweep_of(cloud) * SECOND)]))
        except MissingTransform as error:
            return str(error) if error.late else None
        return None

    def _meet(self, frame: str, frame_id: str, stamp: int) -> None:
        """Missing where the frames are not connected, which may still come where they never were:
        a driver may be found before robot_state_publisher."""
        try:
            self.tree.lookup(frame, frame_id, stamp)
        except MissingTransform as error:
            new = (frame, frame_id) not in self._met and "TF" not in self.lacking
            raise MissingTransform(str(error), error.late or new) from None
        self._met.add((frame, frame_id))

    def _sweep_of(self, cloud: Any) -> float:
        """As of the last cloud that was to be moved; before there is one, of this one, which could
        not wait for the end of its turn otherwise."""
        if self.sweep is None:
            try:
                seconds = read_point_times(cloud, to_frame(cloud)[1]).seconds
            except InputError:  # corrected() says it
                return 0.0
            self.sweep = float(seconds[np.isfinite(seconds)].max(initial=0.0))
        return self.sweep

    def placing(self, header: Any) -> Placement:
        """Of a cloud with this header."""
        key = header.frame_id, to_ns(header.stamp)
        if not (self.base_frame or self.target_frame or self.node.robot.input.ahead):
            return Placement(header.frame_id)
        if self._last[0] != key:
            self._last = key, self._placing(*key)
        return self._last[1]

    def _placing(self, frame_id: str, stamp_ns: int) -> Placement:
        base = self._looked_up("base_frame", self.base_frame, frame_id, stamp_ns)
        if base is not None and not 0.0 <= base[2, 3] <= 50.0:
            self.lacking["base_frame"] = (
                f"'{frame_id}' is {base[2, 3]:.2f} m above '{self.base_frame}', which is to be on "
                "the ground (as base_footprint is); ground.sensor_pose stands")
            base = None
        ahead = np.radians(self.node.robot.input.ahead)
        upright = base
        if upright is None and ahead:  # the turn comes after the tilt, so both are done here
            upright = self._by_hand()
            upright = np.eye(4) if upright is None else upright
        level = None if upright is None else find_level_transform(upright, ahead)
        target = self._looked_up("target_frame", self.target_frame, frame_id, stamp_ns)
        if target is None:
            return Placement(frame_id, base, level, None if level is None else invert_pose(level))
        return Placement(self.target_frame, base, level,
                         target if level is None else target @ invert_pose(level))

    def _looked_up(self, what: str, frame: str, frame_id: str, stamp_ns: int) -> np.ndarray | None:
        """The pose of frame_id in the frame that the parameter `what` names; None where there is
        none, which problems() then says."""
        self.lacking.pop(what, None)
        if not frame:
            return None
        try:
            return self.tree.lookup(frame, frame_id, stamp_ns)
        except MissingTransform as error:
            instead = {"base_frame": "ground.sensor_pose stands",
                       "target_frame": f"results are in '{frame_id}'"}[what]
            self.lacking[what] = f"{what} '{frame}': {error}; {instead}"
            return None

    def mounted(self, params: Any, placing: Placement) -> Any:
        """params, a node's, for a frame that placing has levelled; its params.ground.sensor_pose
        stands where TF has no base_frame."""
        height = params.ground.sensor_pose.height
        if placing.base is not None:
            height = float(placing.base[2, 3])
            self.known["mount"] = f"{height:.3f} m above '{self.base_frame}'"
        if placing.base is not None or placing.level is not None:
            params = replace(params, ground=replace(
                params.ground, sensor_pose=SensorPoseParams(height=height)))
        return params

    def cropped(self, frame: LidarFrame, crop: CropParams, placing: Placement
                ) -> tuple[np.ndarray, LidarFrame]:
        """As robot.crop.cropped. A body in a base_frame that TF does not have is not cropped, as
        it could be anything."""
        self.lacking.pop("crop.body", None)
        if crop.body and self.base_frame:
            if placing.base is None:
                self.lacking["crop.body"] = "crop.body is not left out, as base_frame is not known"
                crop = replace(crop, body=())
            elif crop.body[5] <= 0.0:
                self.lacking["crop.body"] = (
                    f"crop.body ends {-crop.body[5]:.2f} m below the ground of '{self.base_frame}'"
                    ", in which it is read; give it in that frame, as a file of setup has it too")
        level, pose = placing.level, None if placing.base is not None else self._by_hand()
        if level is None and pose is not None:
            level = find_level_transform(pose)
        return crop_frame(frame, crop, placing.base, level)

    def to_level(self, header: Any, frame_id: str) -> np.ndarray:
        """(4, 4): takes points of a frame to the level frame of a cloud with this header. Missing
        where TF does not connect them."""
        if frame_id not in ("", header.frame_id):
            self.listen()
        pose = self.tree.lookup(header.frame_id, frame_id or header.frame_id, to_ns(header.stamp))
        level = self.placing(header).level
        return pose if level is None else level @ pose

    # How the sensor moves

    def sensor_poses(self, source: str, frame_id: str, at: np.ndarray,
                     max_gap: float | None = None) -> np.ndarray:
        """(M, 4, 4): the poses of a frame of the robot at times (M,) ns, in one that does not
        move: by the source odometry or tf, the latter in input.fixed_frame. max_gap as in
        TransformTree.lookup_many. Missing where they are not known."""
        if source == "tf":
            return self.tree.lookup_many(self.node.robot.input.fixed_frame, frame_id, at, max_gap)
        if frame_id.lstrip("/") == self.odometry_frame != "":  # it does not move
            return np.tile(np.eye(4), (len(at), 1, 1))
        return self.odometry_poses(at, max_gap) @ self._on_carrier(frame_id, at, max_gap)

    def odometry_poses(self, at: np.ndarray, max_gap: float | None = None) -> np.ndarray:
        """(M, 4, 4): the poses at times (M,) ns of what the odometry is of. Missing as above."""
        if self.odometry_ns is None:
            topic = self.node.resolve_topic_name("~/input/odometry")
            raise MissingTransform(f"nothing has come on {topic}; remap it to the odometry's topic")
        try:
            return self.odometry.lookup_many(FIXED, MOVING, at, max_gap)
        except MissingTransform as error:
            said = str(error).replace(FIXED, self.odometry_frame).replace(MOVING, self.carrier)
            raise MissingTransform(f"{self.node.resolve_topic_name('~/input/odometry')}: {said}",
                                   error.late) from None

    def _on_carrier(self, frame_id: str, at: np.ndarray, max_gap: float | None) -> np.ndarray:
        """(M or 1, 4, 4): where on what the odometry is of a frame is at times (M,) ns."""
        if frame_id.lstrip("/") == self.carrier:
            return np.eye(4)[None]
        if not self.carrier:
            topic = self.node.resolve_topic_name("~/input/odometry")
            raise MissingTransform(f"the odometry on {topic} says in no child_frame_id what it is "
                                   "of; set it where it is made")
        try:
            return self.tree.lookup_many(self.carrier, frame_id, at, max_gap)
        except MissingTransform as error:
            self.listen()
            pose = self._by_hand() if self.carrier == self.base_frame else None
            if pose is None:
                raise MissingTransform(f"the odometry is of '{self.carrier}': {error}",
                                       error.late) from None
            return pose[None]

    def carries(self, frame_id: str) -> bool:
        """Whether it is known how a frame moves with the odometry: it is that of the odometry, or
        TF connects them."""
        if frame_id.lstrip("/") in (self.carrier, self.odometry_frame):
            return True
        try:
            self._on_carrier(frame_id, np.array([self.odometry_ns]), None)
        except MissingTransform as error:
            return error.late
        return True

    def _by_hand(self) -> np.ndarray | None:
        """The sensor's pose above the ground as the parameters have it."""
        ground = getattr(self.node.params, "ground", None)
        pose = ground and ground.sensor_pose
        return None if pose is None else make_tilted_pose(pose.roll, pose.pitch, pose.height)

    def corrected(self, msg: Any) -> Any:
        """The cloud with its points moved to its stamp; the cloud itself, counted, where what is
        needed for that is not there. What the crop takes for the robot's own body stays, as it
        moves along."""
        if self.node.robot.input.deskew == "off":
            return msg
        begin, counts = perf_counter(), self.node.counts
        self.lacking.pop("deskew", None)
        try:
            moved = self._moved(msg)
        except InputError as error:
            self.lacking["deskew"] = f"input.deskew: {error}; clouds are used as they are"
            counts["not_deskewed"] = counts.get("not_deskewed", 0) + 1
            return msg
        counts["deskewed"] = counts.get("deskewed", 0) + 1
        self.known["deskew_ms"] = f"{(perf_counter() - begin) * 1e3:.1f}"
        return moved

    def _moved(self, msg: Any) -> Any:
        frame, indices = to_frame(msg)
        crop = getattr(self.node.params, "crop", None)
        if crop is not None and crop.enabled:
            kept, frame = self.cropped(frame, crop, self.placing(msg.header))
            indices = indices.take(kept)

        def poses(at: np.ndarray) -> np.ndarray:
            # Also where they are not known yet: the next cloud then waits for the end of its turn.
            self.sweep = float(at.max() - frame.stamp_ns) / SECOND
            return self.sensor_poses(self.node.robot.input.deskew, frame.frame_id, at)

        found = deskew_points(msg, frame, indices, poses)
        if found is None:
            return msg
        known, moved, times = found
        return replace_points(msg, bag_message, indices.take(known), moved, times)

    # For the diagnostics

    def values(self) -> dict[str, Any]:
        """What is known."""
        return self.known

    def problems(self) -> list[Problem]:
        """What is asked for and not there, each with what stands instead."""
        return [(kind, WARN, message) for kind, message in self.lacking.items()]

"""Poses of the sensor in a bag, from odometry and TF."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from itertools import pairwise, takewhile
from typing import Any

import numpy as np

from lidar_perception.data.bag import BagHandle
from lidar_perception.robot.poses import invert_pose, transform_boxes
from lidar_perception.robot.transform_tree import MissingTransform, TransformTree
from lidar_perception.types import InputError
from lidar_perception.wire.topics import ODOMETRY, ODOMETRY_FRAME, TF, TF_STATIC
from lidar_perception.wire.transforms import FIXED, MOVING, ODOMETRY_MESSAGE, TF_MESSAGE, add_odometry, add_transforms
from msg_utils.markers import MarkedObjects

FILTERED_ODOMETRY = "/odometry/filtered"  # topic of robot_localization
MIN_TF_MESSAGES = 500  # /tf messages to read before looking for the sensor's parent frames
MAX_POSE_GAP_S = 0.5  # maximum gap between poses for interpolation, and maximum time of extrapolation


def choose_odometry_topic(topics: Mapping[str, str]) -> str:
    """Choose the odometry topic: /odom, /odometry/filtered, or the only one; "" without any.

    Args:
        topics: {topic: type}.
    """
    odometry_topics = [name for name, type_name in topics.items() if type_name == ODOMETRY_MESSAGE]
    for name in (ODOMETRY, FILTERED_ODOMETRY):
        if name in odometry_topics:
            return name
    return odometry_topics[0] if len(odometry_topics) == 1 else ""


class BagPoses:
    """Poses of the clouds' frame in a fixed frame, interpolated at any time.

    The source is chosen as in the tracker with ego.source auto. With odometry, poses come from the
    odometry and the TF from its child frame to the sensor; if TF does not connect the two frames,
    they are assumed to coincide. Without odometry, poses come from TF: in odom if that is an
    ancestor of the sensor, otherwise in the topmost frame in which the sensor moves.
    """

    def __init__(self, handle: BagHandle, frame_id: str):
        self.handle, self.path, self.frame_id = handle, handle.path, frame_id.lstrip("/")
        self.invalid_count = 0  # number of transforms and odometry messages without a valid pose
        bag = self.handle.get_bag()
        topics = {name: type_name for name, type_name in bag.topics.items() if bag.counts[name]}
        self.transform_topics = {name for name in (TF, TF_STATIC) if topics.get(name) == TF_MESSAGE}
        self.odometry_topic = choose_odometry_topic(topics)

    def __call__(self, stamp_ns: int) -> np.ndarray | None:
        """Return the pose (4, 4) at a time, or None if it is unknown."""
        try:
            return self.lookup(np.array([stamp_ns]))[0]
        except MissingTransform:
            return None

    def lookup(self, times: np.ndarray) -> np.ndarray:
        """Return the poses (M, 4, 4) at times (M,) ns, M > 0.

        Raises MissingTransform if a pose is unknown.
        """
        if self.odometry_topic:
            # The clouds may already be in the fixed frame.
            if self.frame_id == self._first_odometry.header.frame_id.lstrip("/"):
                return np.tile(np.eye(4), (len(times), 1, 1))
            return self.lookup_odometry(times) @ self._find_sensor_in_child_frame(times)
        if not self.fixed_frame:
            raise MissingTransform(
                f"{self.path} has neither odometry nor a TF in which '{self.frame_id}' moves; record one of them"
            )
        return self._tree.lookup_many(self.fixed_frame, self.frame_id, times, MAX_POSE_GAP_S)

    @cached_property
    def has_poses(self) -> bool:
        """True if the bag has poses."""
        return bool(self.odometry_topic or self.fixed_frame)

    @property
    def needs_no_tf(self) -> bool:
        """True if nodes need no TF: the bag has no poses, or /odom is the odometry of the sensor frame."""
        return not self.has_poses or (self.odometry_topic == ODOMETRY and self.odometry_child_frame == self.frame_id)

    @cached_property
    def odometry_child_frame(self) -> str:
        """Child frame of the odometry; "" without odometry."""
        return self._first_odometry.child_frame_id.lstrip("/") if self.odometry_topic else ""

    @cached_property
    def _first_odometry(self) -> Any:
        """First odometry message."""
        return next(msg for *_, msg in self.handle.get_bag().messages({self.odometry_topic}))

    @cached_property
    def fixed_frame(self) -> str:
        """TF frame in which the sensor moves; "" if no ancestor of the sensor moves."""
        fixed_frames = [
            parent for frame, parent in pairwise(self._ancestors) if not self._first_transforms.is_fixed(frame)
        ]
        return ODOMETRY_FRAME if ODOMETRY_FRAME in fixed_frames else fixed_frames[-1] if fixed_frames else ""

    def find_mount(self, base: str) -> np.ndarray | None:
        """Return the pose (4, 4) of the sensor in a frame of the robot; None if it is not constant."""
        base_chain = self._list_parents(base)
        common_ancestor = next((frame for frame in self._ancestors if frame in base_chain), None)
        if common_ancestor is None or not all(
            map(
                self._first_transforms.is_fixed,
                (
                    *self._ancestors[: self._ancestors.index(common_ancestor)],
                    *base_chain[: base_chain.index(common_ancestor)],
                ),
            )
        ):
            return None
        return self._first_transforms.lookup(base, self.frame_id, 0)

    @property
    def base_frame(self) -> str:
        """Frame of the robot: the odometry's child frame, or without odometry the topmost frame in
        which the pose of the sensor is constant; "" without TF."""
        if self.odometry_child_frame and self.odometry_child_frame != self.frame_id:
            return self.odometry_child_frame
        # Stop at the first moving link, because odom may be static in a map above it.
        fixed_count = len([*takewhile(self._first_transforms.is_fixed, self._ancestors[:-1])])
        return self._ancestors[fixed_count] if fixed_count else ""

    def lookup_frame(self, frame_id: str, stamp_ns: int) -> np.ndarray:
        """Return the pose (4, 4) of another frame in the clouds' frame at a time.

        Raises MissingTransform if the pose is unknown.
        """
        if self.odometry_topic and frame_id.lstrip("/") == self._first_odometry.header.frame_id.lstrip("/"):
            return invert_pose(self.lookup(np.array([stamp_ns]))[0])
        return self._tree.lookup(self.frame_id, frame_id, stamp_ns, MAX_POSE_GAP_S)

    def to_cloud_frame(self, objects: MarkedObjects, topic: str) -> MarkedObjects:
        """Return objects with their boxes transformed to the clouds' frame at their stamp.

        Args:
            topic: topic of the objects, for the error message.

        Raises:
            InputError: the bag does not connect the two frames.
        """
        if not len(objects) or not self.frame_id or objects.frame_id.lstrip("/") in ("", self.frame_id):
            return objects
        try:
            pose = self.lookup_frame(objects.frame_id, objects.stamp_ns)
        except MissingTransform as error:
            raise InputError(
                f"{self.path}: cannot transform the boxes on {topic} from '{objects.frame_id}' to the frame of the "
                f"clouds '{self.frame_id}': {error}; record TF or odometry too"
            ) from None
        return replace(objects, boxes=transform_boxes(objects.boxes, pose))

    def lookup_odometry(self, times: np.ndarray) -> np.ndarray:
        """Return the odometry's poses (M, 4, 4) at times (M,) ns.

        Raises MissingTransform if a pose is unknown.
        """
        return self._odometry.lookup_many(FIXED, MOVING, times, MAX_POSE_GAP_S)

    def _find_sensor_in_child_frame(self, times: np.ndarray) -> np.ndarray:
        """Return the pose of the sensor in the odometry's child frame: (4, 4) if it is fixed, otherwise
        (M, 4, 4) at times (M,) ns. Without TF, it is the identity."""
        if not {*self._ancestors} & {*self._list_parents(self.odometry_child_frame)}:
            return np.eye(4)
        if (pose := self.find_mount(self.odometry_child_frame)) is not None:
            return pose
        return self._tree.lookup_many(self.odometry_child_frame, self.frame_id, times, MAX_POSE_GAP_S)

    @cached_property
    def _odometry(self) -> TransformTree:
        tree = TransformTree(keeps_all=True)
        for _, _, msg in self.handle.get_bag().messages({self.odometry_topic} - {""}):
            try:
                add_odometry(tree, msg)
            except InputError:
                self.invalid_count += 1
        return tree

    @cached_property
    def _first_transforms(self) -> TransformTree:
        """Static transforms, and those on /tf until an ancestor of the sensor moves."""
        tree = TransformTree(keeps_all=True)
        bag = self.handle.get_bag()
        for _, _, msg in bag.messages({TF_STATIC} & self.transform_topics):
            self._add(tree, msg, True)
        for i, (_, _, msg) in enumerate(bag.messages({TF} & self.transform_topics)):
            if i >= MIN_TF_MESSAGES and (
                self.odometry_topic or not all(map(tree.is_fixed, _find_chain(tree, self.frame_id)))
            ):
                break  # later transforms may only be those of the wheels
            self._add(tree, msg, False)
        return tree

    @cached_property
    def _ancestors(self) -> list[str]:
        return self._list_parents(self.frame_id)

    def _list_parents(self, frame: str) -> list[str]:
        return _find_chain(self._first_transforms, frame)

    @cached_property
    def _tree(self) -> TransformTree:
        """All transforms of the sensor, of the odometry's child frame, and of their ancestors."""
        tree = TransformTree(keeps_all=True)
        frames = {*self._ancestors, *self._list_parents(self.odometry_child_frame)}
        for topic, _, msg in self.handle.get_bag().messages(self.transform_topics):
            msg.transforms[:] = [
                transform for transform in msg.transforms if transform.child_frame_id.lstrip("/") in frames
            ]
            self._add(tree, msg, topic == TF_STATIC)
        return tree

    def _add(self, tree: TransformTree, msg: object, static: bool) -> None:
        try:
            add_transforms(tree, msg, static)
        except InputError:
            self.invalid_count += 1


def _find_chain(tree: TransformTree, frame: str) -> list[str]:
    """Return the frame and its ancestors up to the root; only the frame if the tree has a cycle."""
    try:
        return tree.find_chain(frame)
    except MissingTransform:
        return [frame]

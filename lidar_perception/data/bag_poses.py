"""Poses of the sensor of a bag, from its odometry and TF."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from itertools import takewhile
from typing import Any

import numpy as np

from lidar_perception.data.bag import BagHandle
from lidar_perception.robot.poses import invert_pose, transform_boxes
from lidar_perception.robot.transform_tree import MissingTransform, TransformTree
from lidar_perception.types import InputError
from lidar_perception.wire.topics import ODOMETRY, ODOMETRY_FRAME, TF, TF_STATIC
from lidar_perception.wire.transforms import FIXED, MOVING, ODOMETRY_MESSAGE, TF_MESSAGE, add_odometry, add_transforms
from msg_utils.markers import MarkedObjects

FILTERED = "/odometry/filtered"  # topic of robot_localization
MIN_TF_MESSAGES = 500  # /tf messages to read before looking for the sensor's parent frames
MAX_POSE_GAP_S = 0.5  # maximum gap between two poses, and before the first and after the last one


def choose_odometry_topic(topics: Mapping[str, str]) -> str:
    """Choose the odometry topic: /odom, /odometry/filtered, or the only one; "" without any.

    Args:
        topics: {topic: type}.
    """
    odometry_topics = [name for name, type_name in topics.items() if type_name == ODOMETRY_MESSAGE]
    preferred = [name for name in (ODOMETRY, FILTERED) if name in odometry_topics]
    return preferred[0] if preferred else odometry_topics[0] if len(odometry_topics) == 1 else ""


class BagPoses:
    """Poses of the clouds' frame in a fixed frame, interpolated at any time.

    The source is chosen like in the tracker with ego.source auto. With odometry, poses come from
    the odometry and the TF from its child frame to the sensor; if TF does not connect the two, they
    are assumed to coincide. Without odometry, poses come from TF: in odom if that is an ancestor of
    the sensor, otherwise in the topmost frame in which the sensor moves.
    """

    def __init__(self, handle: BagHandle, frame_id: str):
        self.handle, self.path, self.frame_id = handle, handle.path, frame_id.lstrip("/")
        self.invalid_count = 0  # transforms and odometry messages without a valid pose
        bag = self.handle.bag()
        topics = {name: type_name for name, type_name in bag.topics.items() if bag.counts[name]}
        self.transforms = {name for name in (TF, TF_STATIC) if topics.get(name) == TF_MESSAGE}
        self.odometry = choose_odometry_topic(topics)

    def __call__(self, stamp_ns: int) -> np.ndarray | None:
        """Return the pose (4, 4) at a time, or None if it is unknown."""
        try:
            return self.lookup(np.array([stamp_ns]))[0]
        except MissingTransform:
            return None

    def lookup(self, times: np.ndarray) -> np.ndarray:
        """Return the poses (M, 4, 4) at times (M,) ns, M > 0.

        Raises MissingTransform if one of them is unknown.
        """
        if self.odometry:
            if self.frame_id == self._first.header.frame_id.lstrip("/"):  # the clouds are already in a fixed frame
                return np.tile(np.eye(4), (len(times), 1, 1))
            return self.odometry_poses(times) @ self._sensor_in_odometry_child(times)
        if not self.fixed:
            raise MissingTransform(
                f"{self.path} has neither odometry nor a TF in which '{self.frame_id}' moves; record one of them"
            )
        return self._tree.lookup_many(self.fixed, self.frame_id, times, MAX_POSE_GAP_S)

    @cached_property
    def available(self) -> bool:
        """True if the bag has poses."""
        return bool(self.odometry or self.fixed)

    @property
    def needs_no_tf(self) -> bool:
        """True if nodes need no TF: there are no poses, or /odom is the sensor's own odometry."""
        return not self.available or (self.odometry == ODOMETRY and self.odometry_child == self.frame_id)

    @cached_property
    def odometry_child(self) -> str:
        """Child frame of the odometry; "" without odometry."""
        return self._first.child_frame_id.lstrip("/") if self.odometry else ""

    @cached_property
    def _first(self) -> Any:
        """First odometry message."""
        return next(msg for *_, msg in self.handle.bag().messages({self.odometry}))

    @cached_property
    def fixed(self) -> str:
        """TF frame in which the sensor moves; "" if no ancestor of the sensor moves."""
        moving = [
            self._above[i + 1] for i, frame in enumerate(self._above[:-1]) if not self._first_transforms.is_fixed(frame)
        ]
        return ODOMETRY_FRAME if ODOMETRY_FRAME in moving else moving[-1] if moving else ""

    def find_mount(self, base: str) -> np.ndarray | None:
        """Return the pose (4, 4) of the sensor in a frame of the robot; None if it is not fixed."""
        base_chain = self._list_parents(base)
        common = next((frame for frame in self._above if frame in base_chain), None)
        if common is None or not all(
            map(
                self._first_transforms.is_fixed,
                (*self._above[: self._above.index(common)], *base_chain[: base_chain.index(common)]),
            )
        ):
            return None
        return self._first_transforms.lookup(base, self.frame_id, 0)

    @property
    def base(self) -> str:
        """Frame of the robot: the odometry's child frame, or without odometry the topmost frame in
        which the sensor is fixed; "" without TF."""
        if self.odometry_child and self.odometry_child != self.frame_id:
            return self.odometry_child
        # Stop at the first moving link, because odom may be static in a map above it.
        fixed = len([*takewhile(self._first_transforms.is_fixed, self._above[:-1])])
        return self._above[fixed] if fixed else ""

    def lookup_frame(self, frame_id: str, stamp_ns: int) -> np.ndarray:
        """Return the pose (4, 4) of another frame in the clouds' frame at a time.

        Raises MissingTransform if it is unknown.
        """
        if self.odometry and frame_id.lstrip("/") == self._first.header.frame_id.lstrip("/"):
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
                f"{self.path}: the boxes on {topic} are in '{objects.frame_id}', the "
                f"clouds in '{self.frame_id}': {error}; record TF or odometry "
                "too"
            ) from None
        return replace(objects, boxes=transform_boxes(objects.boxes, pose))

    def odometry_poses(self, times: np.ndarray) -> np.ndarray:
        """Return the odometry's poses (M, 4, 4) at times (M,) ns. MissingTransform if unknown."""
        return self._odometry.lookup_many(FIXED, MOVING, times, MAX_POSE_GAP_S)

    def _sensor_in_odometry_child(self, times: np.ndarray) -> np.ndarray:
        """Return the pose of the sensor in the odometry's child frame.

        Returns:
            (4, 4) if it is fixed, otherwise (M, 4, 4) at times (M,) ns; identity without TF.
        """
        if not {*self._above} & {*self._list_parents(self.odometry_child)}:
            return np.eye(4)
        if (pose := self.find_mount(self.odometry_child)) is not None:
            return pose
        return self._tree.lookup_many(self.odometry_child, self.frame_id, times, MAX_POSE_GAP_S)

    @cached_property
    def _odometry(self) -> TransformTree:
        tree = TransformTree(keeps_all=True)
        for _, _, msg in self.handle.bag().messages({self.odometry} - {""}):
            try:
                add_odometry(tree, msg)
            except InputError:
                self.invalid_count += 1
        return tree

    @cached_property
    def _first_transforms(self) -> TransformTree:
        """Static transforms, and moving ones until an ancestor of the sensor moves."""
        tree = TransformTree(keeps_all=True)
        bag = self.handle.bag()
        for _, _, msg in bag.messages({TF_STATIC} & self.transforms):
            self._add(tree, msg, True)
        for i, (_, _, msg) in enumerate(bag.messages({TF} & self.transforms)):
            if i >= MIN_TF_MESSAGES and (
                self.odometry or not all(map(tree.is_fixed, _find_chain(tree, self.frame_id)))
            ):
                break  # later messages may only concern the wheels
            self._add(tree, msg, False)
        return tree

    @cached_property
    def _above(self) -> list[str]:
        return self._list_parents(self.frame_id)

    def _list_parents(self, frame: str) -> list[str]:
        return _find_chain(self._first_transforms, frame)

    @cached_property
    def _tree(self) -> TransformTree:
        """All transforms above the sensor and above the child frame of the odometry."""
        tree = TransformTree(keeps_all=True)
        above = {*self._above, *self._list_parents(self.odometry_child)}
        for topic, _, msg in self.handle.bag().messages(self.transforms):
            msg.transforms[:] = [
                transform for transform in msg.transforms if transform.child_frame_id.lstrip("/") in above
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

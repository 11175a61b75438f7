"""Where the sensor of a bag was: by the odometry and the transforms that lie beside its clouds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from itertools import takewhile
from typing import Any

import numpy as np

from lidar_perception.data.bag import KeptOpen
from lidar_perception.robot.poses import invert_pose, transform_boxes
from lidar_perception.robot.transform_tree import MissingTransform, TransformTree
from lidar_perception.types import InputError
from lidar_perception.wire.topics import ODOMETRY, ODOMETRY_FRAME, TF, TF_STATIC
from lidar_perception.wire.transforms import (
    FIXED,
    MOVING,
    ODOMETRY_MESSAGE,
    TF_MESSAGE,
    add_odometry,
    add_transforms,
)
from msg_utils.markers import MarkedObjects

FILTERED = "/odometry/filtered"  # of robot_localization
FIRST = 500    # messages of /tf that show which frames there are, where something moves the sensor
MAX_GAP = 0.5  # seconds between two poses, before the first and after the last


def odometry_topic(topics: Mapping[str, str]) -> str:
    """Of a bag's topics, by name their type, the one with its odometry: /odom, else
    /odometry/filtered, else the only one of that type; "" where there is none, or several."""
    every = [name for name, kind in topics.items() if kind == ODOMETRY_MESSAGE]
    known = [name for name in (ODOMETRY, FILTERED) if name in every]
    return known[0] if known else every[0] if len(every) == 1 else ""


class BagPoses:
    """The poses of the frame of a bag's clouds in one that does not move, interpolated at any time.

    As a tracker has them live, with ego.source auto: by the odometry, carried to the sensor by TF,
    and where TF does not connect them, as if they were in one place; without odometry by TF alone,
    in odom where that is above the sensor, else in the topmost frame that it moves in.
    """

    def __init__(self, opened: KeptOpen, frame_id: str):
        self.opened, self.path, self.frame_id = opened, opened.path, frame_id.lstrip("/")
        self.left_out = 0  # transforms and odometry that are no poses
        bag = self.opened.bag()
        topics = {name: kind for name, kind in bag.topics.items() if bag.counts[name]}
        self.transforms = {name for name in (TF, TF_STATIC) if topics.get(name) == TF_MESSAGE}
        self.odometry = odometry_topic(topics)

    def __call__(self, stamp_ns: int) -> np.ndarray | None:
        """(4, 4) at a time; None where it is not known then."""
        try:
            return self.at(np.array([stamp_ns]))[0]
        except MissingTransform:
            return None

    def at(self, times: np.ndarray) -> np.ndarray:
        """(M, 4, 4) at times (M,) ns, M > 0. Missing where it is not known then."""
        if self.odometry:
            if self.frame_id == self._first.header.frame_id.lstrip("/"):  # the clouds do not move
                return np.tile(np.eye(4), (len(times), 1, 1))
            return self._carrier_poses(times) @ self._on_carrier(times)
        if not self.fixed:
            raise MissingTransform(f"{self.path} has neither odometry nor a TF in which "
                                   f"'{self.frame_id}' moves; record one of them")
        return self._tree.lookup_many(self.fixed, self.frame_id, times, MAX_GAP)

    @cached_property
    def known(self) -> bool:
        """Whether there are poses at all."""
        return bool(self.odometry or self.fixed)

    @property
    def plain(self) -> bool:
        """Whether there are none, or /odom has those of the sensor itself: so nodes need no TF."""
        return not self.known or (self.odometry == ODOMETRY and self.carrier == self.frame_id)

    @cached_property
    def carrier(self) -> str:
        """The frame that the odometry is of; "" without odometry."""
        return self._first.child_frame_id.lstrip("/") if self.odometry else ""

    @cached_property
    def _first(self) -> Any:
        """The first message of the odometry."""
        return next(msg for *_, msg in self.opened.bag().messages({self.odometry}))

    @cached_property
    def fixed(self) -> str:
        """The frame of TF that the sensor moves in; "" where nothing moves in TF."""
        moving = [self._above[i + 1] for i, frame in enumerate(self._above[:-1])
                  if not self._seen.is_fixed(frame)]
        return ODOMETRY_FRAME if ODOMETRY_FRAME in moving else moving[-1] if moving else ""

    def mounted(self, base: str) -> np.ndarray | None:
        """(4, 4): the sensor's pose in a frame of the robot that it does not move in; None where TF
        does not say it."""
        above = self._chain(base)
        both = next((frame for frame in self._above if frame in above), None)
        if both is None or not all(map(self._seen.is_fixed, (
                *self._above[:self._above.index(both)], *above[:above.index(both)]))):
            return None
        return self._seen.lookup(base, self.frame_id, 0)

    @property
    def base(self) -> str:
        """The robot's own frame: that of the odometry, else the last above the sensor in which it
        does not move; "" where TF has none."""
        if self.carrier and self.carrier != self.frame_id:
            return self.carrier
        # Up to what moves: above that odom may be fixed in a map, and is not the robot's.
        fixed = len([*takewhile(self._seen.is_fixed, self._above[:-1])])
        return self._above[fixed] if fixed else ""

    def of(self, frame_id: str, stamp_ns: int) -> np.ndarray:
        """(4, 4): the pose of another frame in that of the clouds at a time, which takes points to
        the latter. Missing where nothing says it."""
        if self.odometry and frame_id.lstrip("/") == self._first.header.frame_id.lstrip("/"):
            return invert_pose(self.at(np.array([stamp_ns]))[0])
        return self._tree.lookup(self.frame_id, frame_id, stamp_ns, MAX_GAP)

    def brought(self, objects: MarkedObjects, topic: str) -> MarkedObjects:
        """Objects of a topic with their boxes in the frame of the clouds at their stamp, as nodes
        give them in another one where they are asked to. InputError where the bag connects the two
        frames by nothing."""
        if not len(objects) or not self.frame_id or objects.frame_id.lstrip("/") in (
                "", self.frame_id):
            return objects
        try:
            pose = self.of(objects.frame_id, objects.stamp_ns)
        except MissingTransform as error:
            raise InputError(f"{self.path}: the boxes on {topic} are in '{objects.frame_id}', the "
                             f"clouds in '{self.frame_id}': {error}; record TF, or the odometry, "
                             "with them") from None
        return replace(objects, boxes=transform_boxes(objects.boxes, pose))

    def carrier_pose(self, stamp_ns: int) -> np.ndarray:
        """(4, 4): that of the odometry. Missing where it is not known then."""
        return self._carrier_poses(np.array([stamp_ns]))[0]

    def _carrier_poses(self, times: np.ndarray) -> np.ndarray:
        return self._odometry.lookup_many(FIXED, MOVING, times, MAX_GAP)

    def _on_carrier(self, times: np.ndarray) -> np.ndarray:
        """(4, 4), or (M, 4, 4) where it moves on it: where on the carrier the sensor is at times
        (M,) ns; as if in one place where TF does not say."""
        if not {*self._above} & {*self._chain(self.carrier)}:
            return np.eye(4)
        if (pose := self.mounted(self.carrier)) is not None:
            return pose
        return self._tree.lookup_many(self.carrier, self.frame_id, times, MAX_GAP)

    @cached_property
    def _odometry(self) -> TransformTree:
        tree = TransformTree(keeps_all=True)
        for _, _, msg in self.opened.bag().messages({self.odometry} - {""}):
            try:
                add_odometry(tree, msg)
            except InputError:
                self.left_out += 1
        return tree

    @cached_property
    def _seen(self) -> TransformTree:
        """What is fixed, and of what moves the first, until something above the sensor moves."""
        tree = TransformTree(keeps_all=True)
        bag = self.opened.bag()
        for _, _, msg in bag.messages({TF_STATIC} & self.transforms):
            self._add(tree, msg, True)
        for i, (_, _, msg) in enumerate(bag.messages({TF} & self.transforms)):
            if i >= FIRST and (self.odometry or not all(map(tree.is_fixed, _chain_in(
                    tree, self.frame_id)))):
                break  # wheels may turn for long before the robot is localised
            self._add(tree, msg, False)
        return tree

    @cached_property
    def _above(self) -> list[str]:
        return self._chain(self.frame_id)

    def _chain(self, frame: str) -> list[str]:
        return _chain_in(self._seen, frame)

    @cached_property
    def _tree(self) -> TransformTree:
        """All of what moves and what is fixed, above the sensor and what the odometry is of."""
        tree, above = TransformTree(keeps_all=True), {*self._above, *self._chain(self.carrier)}
        for topic, _, msg in self.opened.bag().messages(self.transforms):
            msg.transforms[:] = [each for each in msg.transforms
                                 if each.child_frame_id.lstrip("/") in above]
            self._add(tree, msg, topic == TF_STATIC)
        return tree

    def _add(self, tree: TransformTree, msg: object, static: bool) -> None:
        try:
            add_transforms(tree, msg, static)
        except InputError:
            self.left_out += 1


def _chain_in(tree: TransformTree, frame: str) -> list[str]:
    """A frame, its parent, and so on; it alone where they go round."""
    try:
        return tree.find_chain(frame)
    except MissingTransform:
        return [frame]

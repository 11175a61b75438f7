"""Inputs that several nodes share: the camera, and messages that belong to one cloud."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from lidar_perception.camera import Camera
from lidar_perception.candidates.params import SeedParams
from lidar_perception.candidates.seed_sources import (
    SeedSource,
    make_automatic_source,
    make_click_source,
    make_truth_source,
)
from lidar_perception.candidates.seeds import Seed, load_seed
from lidar_perception.candidates.segmented_cloud import SegmentedCloud
from lidar_perception.nodes.graph import relative
from lidar_perception.nodes.runtime import (
    JUMP_NS,
    LATCHED,
    MARKERS,
    RELIABLE,
    SENSOR_DATA,
    LidarNode,
)
from lidar_perception.robot.poses import invert_pose, transform_boxes, transform_points
from lidar_perception.robot.transform_tree import MissingTransform
from lidar_perception.types import PEDESTRIAN, InputError
from lidar_perception.wire.messages import make_calibration, read_camera, to_truth
from lidar_perception.wire.params import ViewParams
from lidar_perception.wire.topics import CLICK
from msg_utils.markers import from_marker_array
from msg_utils.stamps import to_ns


class CameraInput:
    """The camera from ~/input/camera_info and ~/input/extrinsics, or from TF."""

    def __init__(self, node: LidarNode):
        self.node = node
        self.info: Any = None
        self.transforms: dict[tuple[str, str], Any] = {}
        # A latched subscription gets what was sent before, but nothing of a camera driver, which is
        # volatile and often best effort.
        node.input("camera_info", "sensor_msgs/msg/CameraInfo", self._on_info, LATCHED,
                   SENSOR_DATA)
        node.input("extrinsics", "geometry_msgs/msg/TransformStamped", self._on_transform,
                   LATCHED, SENSOR_DATA)

    def _on_info(self, msg: Any) -> None:
        self.info = msg

    def _on_transform(self, msg: Any) -> None:
        self.transforms[msg.header.frame_id, msg.child_frame_id] = msg

    def missing(self, cloud: Any) -> str | None:
        """What a cloud waits for; None if it can be cropped, or is not to be."""
        params = self.node.params.view
        if not params.enabled or self.get(cloud.header, params) is not None:
            return None
        info, extrinsics = map(self.node.resolve_topic_name, (
            "~/input/camera_info", "~/input/extrinsics"))
        return "the camera's calibration: " + (
            f"no CameraInfo has come on {info}" if self.info is None else
            f"neither {extrinsics} nor TF connects the cloud's '{cloud.header.frame_id}' with the "
            f"CameraInfo's '{self.info.header.frame_id}'")

    def get(self, header: Any, params: ViewParams) -> Camera | None:
        """The camera for the levelled points of a cloud with this header; None until it is known
        where it is, and while view is off."""
        if not params.enabled or self.info is None:
            return None
        lidar, camera = header.frame_id, self.info.header.frame_id
        transform = self.transforms.get((lidar, camera)) or self.transforms.get((camera, lidar))
        level = self.node.transforms.placing(header).level
        if transform is not None:
            found = read_camera(self.info, transform)
        else:
            try:
                pose = self.node.transforms.tree.lookup(camera, lidar, to_ns(header.stamp))
            except MissingTransform:
                self.node.transforms.listen()
                return None
            found = make_calibration(self.info, pose).camera()
        return found if level is None else replace(
            found, projection=found.projection @ invert_pose(level))


class Paired:
    """Clouds that wait for the message with the same stamp from another topic.

    A cloud is given out with its partner; without one when a later partner or too many clouds
    have come, as then its own is lost. When time goes back, what is from before is dropped, and
    dropped told how many clouds that are.
    """

    def __init__(self, deliver: Callable[[Any, Any], None], capacity: int = 5,
                 dropped: Callable[[int], None] = lambda _: None):
        self.deliver, self.capacity, self.dropped = deliver, capacity, dropped
        self.clouds: OrderedDict[int, Any] = OrderedDict()
        self.partners: OrderedDict[int, Any] = OrderedDict()

    def add_cloud(self, stamp_ns: int, msg: Any) -> None:
        self._drop_later(stamp_ns)
        self.clouds[stamp_ns] = msg
        self._flush()

    def add_partner(self, stamp_ns: int, msg: Any) -> None:
        self._drop_later(stamp_ns)
        self.partners[stamp_ns] = msg
        while len(self.partners) > 20 * self.capacity:
            self.partners.popitem(last=False)
        self._flush()

    def _flush(self) -> None:
        while self.clouds:
            stamp, cloud = next(iter(self.clouds.items()))
            newest = next(reversed(self.partners), None)
            partner = self.partners.get(stamp)
            late = newest is not None and newest > stamp
            if partner is None and not late and len(self.clouds) <= self.capacity:
                return
            del self.clouds[stamp]
            self.deliver(cloud, partner)

    def clear(self) -> None:
        """Drop all that waits."""
        self._drop_later(-JUMP_NS - 1)

    def _drop_later(self, stamp_ns: int) -> None:
        """Drop all if the last of them is from before a jump back to stamp_ns."""
        for waiting in (self.clouds, self.partners):
            if waiting and next(reversed(waiting)) > stamp_ns + JUMP_NS:
                if waiting is self.clouds:
                    self.dropped(len(waiting))
                waiting.clear()


class SeedInput:
    """The seed pedestrian of each cloud, from the source that the parameters name.

    deliver(cloud message, seed source) is called for each cloud, in order. The source raises
    InputError where there is no seed yet.
    """

    def __init__(self, node: LidarNode, deliver: Callable[[Any, SeedSource], None]):
        self.node, self.deliver = node, deliver
        self.click: Any = None
        self.clicked: Seed | None = None
        self.loaded: tuple[str, Seed] | None = None
        self.paired = Paired(self._deliver_with_truth, dropped=self._count)
        node.input("ground_truth", MARKERS, self._on_truth, RELIABLE)
        node.input(relative(CLICK), "geometry_msgs/msg/PointStamped", self._on_click, RELIABLE,
                   private=False)
        node.inputs.append(self)
        if self.params.source in ("file", "automatic"):
            self._template()  # a missing one is known before the first cloud

    def open(self) -> None:
        """The node is active."""

    def close(self) -> None:
        """The node is not active any more: what waits is too old when it is again."""
        self.paired.clear()

    @property
    def params(self) -> SeedParams:
        return self.node.params.seed

    def add_cloud(self, msg: Any) -> None:
        if self.params.source == "ground_truth":
            self.paired.add_cloud(to_ns(msg.header.stamp), msg)
        elif self.params.source == "click":
            self.deliver(msg, partial(self._from_click, msg.header))
        else:
            self.deliver(msg, self._from_file)

    def _template(self) -> Seed:
        if self.loaded is None or self.loaded[0] != self.params.file:
            self.loaded = (self.params.file, load_seed(self.params.file))
        return self.loaded[1]

    def _from_file(self, segmented: SegmentedCloud) -> Seed:
        template = self._template()
        return template if self.params.source == "file" else make_automatic_source(
            template, self.node.params)(segmented)

    def _on_truth(self, msg: Any) -> None:
        objects = from_marker_array(msg)
        if not objects.stamp_ns:
            raise InputError("labels without a header.stamp belong to no cloud; send a DELETEALL "
                             "with the header of the frame where nothing is labelled")
        self.paired.add_partner(objects.stamp_ns, to_truth(objects))

    def _count(self, dropped: int) -> None:
        self.node.counts["dropped"] = self.node.counts.get("dropped", 0) + dropped

    def _deliver_with_truth(self, cloud: Any, truth: Any) -> None:
        if truth is None:
            self.deliver(cloud, _missing("no ground truth with the stamp of this cloud; is it "
                                         "published, with the same header.stamp?"))
        else:
            people = truth.of_class(PEDESTRIAN)
            level = self.node.transforms.placing(cloud.header).level
            self.deliver(cloud, make_truth_source(people if level is None
                                                  else transform_boxes(people, level)))

    def _on_click(self, msg: Any) -> None:
        self.click, self.clicked = msg, None

    def _from_click(self, header: Any, segmented: SegmentedCloud) -> Seed:
        if self.click is None:
            raise InputError("no seed yet: click a pedestrian (a PointStamped on "
                             f"{relative(CLICK)}, as RViz and Foxglove publish it)")
        if self.clicked is None:
            p, frame_id = self.click.point, self.click.header.frame_id
            try:
                pose = self.node.transforms.to_level(header, frame_id)
            except MissingTransform as error:
                raise InputError(f"the clicked point is in frame '{frame_id}' but the cloud in "
                                 f"'{header.frame_id}' ({error}); set that as the fixed frame and "
                                 "click again") from None
            point = transform_points(np.array([[p.x, p.y, p.z]]), pose)[0]
            self.clicked = make_click_source(point, self.params)(segmented)
            self.node.get_logger().info(f"seed taken at ({p.x:.1f}, {p.y:.1f}, {p.z:.1f}), height "
                                        f"{self.clicked.height:.2f} m")
        return self.clicked


def _missing(reason: str) -> SeedSource:
    def source(segmented: SegmentedCloud) -> Seed:
        raise InputError(reason)
    return source

"""Inputs shared by several nodes: the camera calibration, and the seeds of each cloud."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from lidar_perception.camera import Camera
from lidar_perception.candidates.params import SeedParams
from lidar_perception.candidates.seed_sources import SeedSource, make_click_source, make_truth_source
from lidar_perception.candidates.seeds import Seed, load_seeds
from lidar_perception.candidates.segmented_cloud import SegmentedCloud
from lidar_perception.nodes.graph import make_relative
from lidar_perception.nodes.interfaces import LATCHED, MARKERS, RELIABLE, SENSOR_DATA
from lidar_perception.nodes.runtime import LidarNode
from lidar_perception.robot.poses import invert_pose, transform_boxes, transform_points
from lidar_perception.robot.transform_tree import JUMP_NS, MissingTransform
from lidar_perception.runs.compiling import lock_compilation
from lidar_perception.types import PEDESTRIAN, InputError
from lidar_perception.wire.messages import make_calibration, read_calibration, to_truth
from lidar_perception.wire.params import ViewParams
from lidar_perception.wire.topics import CLICK
from msg_utils.markers import from_marker_array
from msg_utils.stamps import to_ns


class CameraInput:
    """Camera calibration from ~/input/camera_info, and from ~/input/extrinsics or TF."""

    def __init__(self, node: LidarNode):
        self.node = node
        self.info: Any = None
        self.transforms: dict[tuple[str, str], Any] = {}
        # The latched subscription receives messages sent before it existed. The second one is for
        # camera drivers, which publish volatile and often best effort.
        node.inputs.subscribe("camera_info", "sensor_msgs/msg/CameraInfo", self._on_info, LATCHED, SENSOR_DATA)
        node.inputs.subscribe(
            "extrinsics", "geometry_msgs/msg/TransformStamped", self._on_transform, LATCHED, SENSOR_DATA
        )

    def _on_info(self, msg: Any) -> None:
        self.info = msg

    def _on_transform(self, msg: Any) -> None:
        self.transforms[msg.header.frame_id, msg.child_frame_id] = msg

    def find_missing_input(self, cloud: Any) -> str | None:
        """Return a description of the data that a cloud needs to be cropped, or None."""
        params = self.node.params.view
        if not params.enabled or self.get(cloud.header, params) is not None:
            return None
        info, extrinsics = map(self.node.resolve_topic_name, ("~/input/camera_info", "~/input/extrinsics"))
        return "the camera's calibration: " + (
            f"no CameraInfo on {info}"
            if self.info is None
            else f"neither {extrinsics} nor TF connects the cloud's '{cloud.header.frame_id}' with the "
            f"CameraInfo's '{self.info.header.frame_id}'"
        )

    def get(self, header: Any, params: ViewParams) -> Camera | None:
        """Return the camera for points in the level frame of a cloud.

        Returns None if view.enabled is false, or while the calibration is incomplete.
        """
        if not params.enabled or self.info is None:
            return None
        lidar, camera = header.frame_id, self.info.header.frame_id
        transform = self.transforms.get((lidar, camera)) or self.transforms.get((camera, lidar))
        level = self.node.transforms.find_placement(header).level
        if transform is not None:
            result = read_calibration(self.info, transform).camera()
        else:
            try:
                pose = self.node.transforms.tree.lookup(camera, lidar, to_ns(header.stamp))
            except MissingTransform:
                self.node.transforms.subscribe_to_tf()
                return None
            result = make_calibration(self.info, pose).camera()
        return result if level is None else replace(result, projection=result.projection @ invert_pose(level))


class StampMatcher:
    """Pairs clouds with the messages of another topic that have the same stamp.

    A cloud is delivered with its partner, or without one if a later partner or too many clouds have
    arrived. If time jumps back, all pending messages are dropped.

    Args:
        deliver: called with a cloud and its partner or None.
        capacity: number of clouds that may wait.
        on_drop: called with the number of dropped clouds.
    """

    def __init__(
        self, deliver: Callable[[Any, Any], None], capacity: int = 5, on_drop: Callable[[int], None] = lambda _: None
    ):
        self.deliver, self.capacity, self.on_drop = deliver, capacity, on_drop
        self.clouds: OrderedDict[int, Any] = OrderedDict()
        self.partners: OrderedDict[int, Any] = OrderedDict()

    def add_cloud(self, stamp_ns: int, msg: Any) -> None:
        self._drop_if_time_jumped_back(stamp_ns)
        self.clouds[stamp_ns] = msg
        self._flush()

    def add_partner(self, stamp_ns: int, msg: Any) -> None:
        self._drop_if_time_jumped_back(stamp_ns)
        self.partners[stamp_ns] = msg
        while len(self.partners) > 20 * self.capacity:
            self.partners.popitem(last=False)
        self._flush()

    def _flush(self) -> None:
        while self.clouds:
            stamp, cloud = next(iter(self.clouds.items()))
            newest_partner = next(reversed(self.partners), None)
            partner = self.partners.get(stamp)
            is_late = newest_partner is not None and newest_partner > stamp
            if partner is None and not is_late and len(self.clouds) <= self.capacity:
                return
            del self.clouds[stamp]
            self.deliver(cloud, partner)

    def clear(self) -> None:
        """Drop all pending messages."""
        self._drop_if_time_jumped_back(-JUMP_NS - 1)

    def _drop_if_time_jumped_back(self, stamp_ns: int) -> None:
        """Drop all pending messages if they are more than JUMP_NS ahead of stamp_ns."""
        for messages in (self.clouds, self.partners):
            if messages and next(reversed(messages)) > stamp_ns + JUMP_NS:
                if messages is self.clouds:
                    self.on_drop(len(messages))
                messages.clear()


class SeedInput:
    """Provides seed pedestrians for each cloud, from the source that the parameters select.

    deliver(cloud message, seed source) is called for each cloud, in order. The seed source raises
    InputError while there is no seed.
    """

    def __init__(self, node: LidarNode, deliver: Callable[[Any, SeedSource], None]):
        self.node, self.deliver = node, deliver
        self.new_clicks: deque[Any] = deque()
        self.clicked_seeds: tuple[Seed, ...] = ()
        self.loaded_templates: tuple[str, tuple[Seed, ...]] | None = None
        self.is_automatic_seed_warm = False
        self.matcher = StampMatcher(self._deliver_with_truth, on_drop=self._count_dropped)
        node.inputs.subscribe("ground_truth", MARKERS, self._on_truth, RELIABLE)
        node.inputs.subscribe(
            make_relative(CLICK), "geometry_msgs/msg/PointStamped", self._on_click, RELIABLE, private=False
        )
        node.inputs.items.append(self)
        if self.params.source == "file":
            self._load_templates()  # a missing file is reported before the first cloud
        elif self.params.source == "automatic":
            self._warm_up_automatic_seed()

    def open(self) -> None:
        """Do nothing; the node opens its subscriptions."""

    def close(self) -> None:
        """Drop pending messages, which would be too old when the node is active again."""
        self.matcher.clear()

    @property
    def params(self) -> SeedParams:
        return self.node.params.seed

    def add_cloud(self, msg: Any) -> None:
        if self.params.source == "ground_truth":
            self.matcher.add_cloud(to_ns(msg.header.stamp), msg)
        elif self.params.source == "click":
            self.deliver(msg, partial(self._make_clicked_seeds, msg.header))
        elif self.params.source == "automatic":
            self._warm_up_automatic_seed()
            from lidar_perception.detectors.automatic_seed import make_automatic_source

            self.deliver(msg, make_automatic_source(self.params))
        else:
            self.deliver(msg, lambda _: self._load_templates())

    def _warm_up_automatic_seed(self) -> None:
        if not self.is_automatic_seed_warm:
            from lidar_perception.detectors.automatic_seed import warm_up_automatic_seed

            with lock_compilation(self.node.get_logger().info):
                warm_up_automatic_seed()
            self.is_automatic_seed_warm = True

    def _load_templates(self) -> tuple[Seed, ...]:
        if self.loaded_templates is None or self.loaded_templates[0] != self.params.file:
            self.loaded_templates = (self.params.file, load_seeds(self.params.file))
        return self.loaded_templates[1]

    def _on_truth(self, msg: Any) -> None:
        objects = from_marker_array(msg)
        if not objects.stamp_ns:
            raise InputError(
                "labels without a header.stamp cannot be matched to a cloud; for a frame without "
                "objects, send a DELETEALL marker with the header of the frame"
            )
        self.matcher.add_partner(objects.stamp_ns, to_truth(objects))

    def _count_dropped(self, dropped: int) -> None:
        self.node.diagnostics.counts["dropped"] = self.node.diagnostics.counts.get("dropped", 0) + dropped

    def _deliver_with_truth(self, cloud: Any, truth: Any) -> None:
        if truth is None:
            self.deliver(
                cloud,
                _make_failing_source("no ground truth for this cloud; is it published with the same header.stamp?"),
            )
        else:
            people = truth.select_class(PEDESTRIAN)
            level = self.node.transforms.find_placement(cloud.header).level
            self.deliver(cloud, make_truth_source(people if level is None else transform_boxes(people, level)))

    def _on_click(self, msg: Any) -> None:
        self.new_clicks.append(msg)
        while len(self.new_clicks) > self.params.bank:
            self.new_clicks.popleft()

    def _make_clicked_seeds(self, header: Any, segmented_cloud: SegmentedCloud) -> tuple[Seed, ...]:
        while self.new_clicks:
            try:
                seed = self._make_clicked_seed(self.new_clicks[0], header, segmented_cloud)
            except InputError:
                if len(self.new_clicks) == 1:  # report the problem until the next click
                    raise
            else:
                self.clicked_seeds = (*self.clicked_seeds, seed)
            self.new_clicks.popleft()
        self.clicked_seeds = self.clicked_seeds[-self.params.bank :]
        if not self.clicked_seeds:
            raise InputError(
                "no seed yet: click a pedestrian (a PointStamped on "
                f"{make_relative(CLICK)}, as RViz and Foxglove publish it)"
            )
        return self.clicked_seeds

    def _make_clicked_seed(self, click: Any, header: Any, segmented_cloud: SegmentedCloud) -> Seed:
        p, frame_id = click.point, click.header.frame_id
        try:
            pose = self.node.transforms.to_level(header, frame_id)
        except MissingTransform as error:
            raise InputError(
                f"the clicked point is in frame '{frame_id}' and the cloud in '{header.frame_id}' ({error}); "
                "set the fixed frame of the viewer to the cloud's frame and click again"
            ) from None
        point = transform_points(np.array([[p.x, p.y, p.z]]), pose)[0]
        (seed,) = make_click_source(point, self.params)(segmented_cloud)
        self.node.get_logger().info(f"seed selected at ({p.x:.1f}, {p.y:.1f}, {p.z:.1f}), height {seed.height:.2f} m")
        return seed


def _make_failing_source(reason: str) -> SeedSource:
    """Return a seed source that raises InputError with this reason."""

    def raise_error(segmented_cloud: SegmentedCloud) -> tuple[Seed, ...]:
        raise InputError(reason)

    return raise_error

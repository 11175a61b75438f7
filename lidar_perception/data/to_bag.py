"""Writer of labelled frames to a rosbag2 bag, on the topics that nodes and evaluation expect."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.bag import BagWriter
from lidar_perception.data.bag_metadata import LATCHED_QOS
from lidar_perception.data.frame import Frame, PointTruth
from lidar_perception.types import GroundTruth, InputError, PointCloud
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.messages import make_camera_info, make_extrinsics, make_odometry, make_truth_markers
from lidar_perception.wire.topics import (
    CAMERA_FRAME,
    CAMERA_INFO,
    EXTRINSICS,
    IMAGE,
    INSTANCE,
    LIDAR_FRAME,
    ODOMETRY,
    ODOMETRY_FRAME,
    POINTS,
    SEMANTIC,
    TF_STATIC,
    TRUTH,
    TRUTH_3D,
)
from msg_utils.detections import to_detection_array
from msg_utils.markers import from_marker_array, list_marker_keys
from msg_utils.point_cloud2 import from_array
from msg_utils.stamps import make_header

MARKERS = "visualization_msgs/msg/MarkerArray"
DETECTIONS_3D = "vision_msgs/msg/Detection3DArray"
POINT_LABELS = np.dtype([(SEMANTIC, "<u2"), (INSTANCE, "<u2")])  # see data.frame.PointTruth
POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])


def write_bag(
    path: str | Path,
    frames: Iterable[Frame],
    *,
    images: bool = False,
    force: bool = False,
    skipped: list[str] | None = None,
    clouds: bool = True,
    detections_3d: bool = False,
) -> int:
    """Write frames to a bag in order; return the number of frames that were written.

    The calibration is written to latched topics (CameraInfo, TransformStamped and TF) before the
    first scan and whenever it changes. Poses are written as odometry of the sensor, and point
    labels as columns of their cloud.

    Args:
        images: write the PNG images of the camera.
        force: replace an existing bag.
        skipped: list to which the errors of unreadable frames are added. If it is None, the first
            error is raised.
        clouds: False to write everything except clouds.
        detections_3d: also write the labelled boxes as Detection3DArray.

    Raises:
        InputError: the bag cannot be written, or a frame cannot be read.
    """
    with BagWriter(path, force=force) as bag:
        writer = FrameWriter(bag, images=images, clouds=clouds, detections_3d=detections_3d)
        count = 0
        for frame in frames:
            try:
                content = writer.read(frame)
            except InputError as error:
                if skipped is None:
                    raise
                skipped.append(str(error))
                continue
            writer.write(content)
            count += 1
    return count


class FrameContent(NamedTuple):
    """Content of a frame that is written to a bag; missing parts are None."""

    header: Any
    stamp_ns: int
    calibration: Calibration | None
    pose: np.ndarray | None
    truth: GroundTruth | None
    image: Path | None
    points: np.ndarray | None


class FrameWriter:
    """Writer of frames to an open bag, see write_bag."""

    def __init__(
        self, bag: BagWriter, *, images: bool = False, clouds: bool = True, detections_3d: bool = False
    ) -> None:
        self.bag, self.images, self.clouds, self.detections_3d = bag, images, clouds, detections_3d
        self._marker_keys: frozenset[tuple[str, int]] = frozenset()  # keys of the last label markers
        self._labelled_stamps: set[int] = set()
        self._calibration: Calibration | None = None  # last calibration written
        bag.add_topic(CAMERA_INFO, "sensor_msgs/msg/CameraInfo", LATCHED_QOS)
        bag.add_topic(EXTRINSICS, "geometry_msgs/msg/TransformStamped", LATCHED_QOS)
        bag.add_topic(TF_STATIC, "tf2_msgs/msg/TFMessage", LATCHED_QOS)
        bag.add_topic(TRUTH, MARKERS)
        if detections_3d:
            bag.add_topic(TRUTH_3D, DETECTIONS_3D)
        if clouds:
            bag.add_topic(POINTS, "sensor_msgs/msg/PointCloud2")

    def read(self, frame: Frame) -> FrameContent:
        """Read the content of a frame. Raises InputError if it cannot be read or stored in a bag."""
        scan, truth, calibration = frame.load(), frame.truth(), frame.calibration()
        pose, columns = frame.pose(), frame.point_truth() if self.clouds else None
        if frame.stamp_ns < 0:
            raise InputError(
                f"{frame.name}: the stamp is before 1970, which a bag cannot store; set the clock of the sensor"
            )
        if truth is not None and frame.stamp_ns in self._labelled_stamps:
            raise InputError(
                f"{frame.name}: another labelled scan has the same stamp, so the labels would be ambiguous; "
                "correct the stamps"
            )
        header = make_header(frame.stamp_ns, scan.frame_id or LIDAR_FRAME, make_bag_message)
        image = frame.image if self.images and frame.image and frame.image.exists() else None
        return FrameContent(
            header,
            frame.stamp_ns,
            calibration,
            pose,
            truth,
            image,
            to_point_array(scan, columns) if self.clouds else None,
        )

    def write(self, content: FrameContent) -> None:
        """Write the content of a frame. Raises InputError if the bag cannot be written."""
        bag, (header, stamp_ns, calibration, pose, truth, image, points) = self.bag, content
        if calibration is not None and not calibration.equals(self._calibration):
            self._calibration = calibration
            _write_calibration(bag, calibration, stamp_ns, header)
        if pose is not None:
            _write_pose(bag, pose, stamp_ns, header.frame_id)
        if truth is not None:
            self._labelled_stamps.add(stamp_ns)
            markers = make_truth_markers(truth, header, make_bag_message, self._marker_keys)
            self._marker_keys = list_marker_keys(markers)
            bag.write(TRUTH, stamp_ns, markers)
            if self.detections_3d:
                bag.write(TRUTH_3D, stamp_ns, _make_detections(markers, header))
        if image is not None:
            _write_image(bag, image, stamp_ns)
        if points is not None:
            bag.write(POINTS, stamp_ns, from_array(points, header, make_bag_message))


def to_point_array(scan: PointCloud, labels: PointTruth | None = None) -> np.ndarray:
    """Make a structured array (N,) with the fields of POINT and, with labels, of POINT_LABELS."""
    fields = POINT.descr[: 4 if scan.intensity is not None else 3]
    points = np.empty(len(scan), fields + (POINT_LABELS.descr if labels else []))
    for i, axis in enumerate("xyz"):
        points[axis] = scan.xyz[:, i]
    if scan.intensity is not None:
        points["intensity"] = scan.intensity
    if labels is not None:
        points[SEMANTIC], points[INSTANCE] = labels.classes, labels.instances
    return points


def _make_detections(markers: Any, header: Any) -> Any:
    """Convert label markers to a Detection3DArray, with the track ids if they are unique."""
    objects = from_marker_array(markers)
    track_ids = [track_id for extra in objects.extras if (track_id := extra.get("track_id")) is not None]
    has_unique_ids = len(set(track_ids)) == len(objects)
    return to_detection_array(
        objects.boxes,
        objects.labels,
        objects.scores.tolist(),
        header=header,
        make=make_bag_message,
        ids=track_ids if has_unique_ids else None,
    )


def _write_image(bag: BagWriter, image: Path, stamp_ns: int) -> None:
    if IMAGE not in bag.channels:
        bag.add_topic(IMAGE, "sensor_msgs/msg/CompressedImage")
    header = make_header(stamp_ns, CAMERA_FRAME, make_bag_message)
    bag.write(
        IMAGE,
        stamp_ns,
        make_bag_message(
            "sensor_msgs/msg/CompressedImage", header=header, format="png", data=np.fromfile(image, np.uint8)
        ),
    )


def _write_pose(bag: BagWriter, pose: np.ndarray, stamp_ns: int, frame_id: str) -> None:
    if ODOMETRY not in bag.channels:
        bag.add_topic(ODOMETRY, "nav_msgs/msg/Odometry")
    header = make_header(stamp_ns, ODOMETRY_FRAME, make_bag_message)
    bag.write(ODOMETRY, stamp_ns, make_odometry(pose, header, frame_id, make_bag_message))


def _write_calibration(bag: BagWriter, calibration: Calibration, stamp_ns: int, header) -> None:
    camera_header = make_header(stamp_ns, CAMERA_FRAME, make_bag_message)
    transform = make_extrinsics(calibration, header, make_bag_message)
    bag.write(CAMERA_INFO, stamp_ns, make_camera_info(calibration, camera_header, make_bag_message))
    bag.write(EXTRINSICS, stamp_ns, transform)
    bag.write(TF_STATIC, stamp_ns, make_bag_message("tf2_msgs/msg/TFMessage", transforms=[transform]))

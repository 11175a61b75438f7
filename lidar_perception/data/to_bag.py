"""Labelled scans to one rosbag2 bag, as the nodes and the evaluation expect it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.bag import LATCHED_QOS, BagWriter
from lidar_perception.data.kitti.folder import KittiFrame
from lidar_perception.types import GroundTruth
from lidar_perception.wire.codec import bag_message
from lidar_perception.wire.messages import camera_info, extrinsics, truth_markers
from lidar_perception.wire.topics import (
    CAMERA_FRAME,
    CAMERA_INFO,
    EXTRINSICS,
    IMAGE,
    LIDAR_FRAME,
    POINTS,
    TF_STATIC,
    TRUTH,
)
from msg_utils.markers import marker_keys
from msg_utils.point_cloud2 import from_array
from msg_utils.stamps import header_message

POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])


@dataclass(frozen=True)
class Scan:
    """cloud (N, 4) float32 [x y z intensity]; truth, calibration and image (a PNG file) where
    there are any."""

    cloud: np.ndarray
    stamp_ns: int
    truth: GroundTruth | None = None
    calibration: Calibration | None = None
    image: Path | None = None


def kitti_scan(frame: KittiFrame, images: bool = False) -> Scan:
    """Read all of a KITTI frame. InputError names the file that is missing or broken."""
    image = frame.image if images and frame.image and frame.image.exists() else None
    return Scan(frame.cloud(), frame.stamp_ns, frame.truth(), frame.calibration(), image)


def write_bag(path: str | Path, scans: Iterable[Scan], *, force: bool = False) -> int:
    """Write scans in order; returns how many. The calibration is written, latched, whenever it
    changes, before the scan it belongs to: as CameraInfo, as TransformStamped and as TF."""
    with BagWriter(path, force=force) as bag:
        bag.add_topic(CAMERA_INFO, "sensor_msgs/msg/CameraInfo", LATCHED_QOS)
        bag.add_topic(EXTRINSICS, "geometry_msgs/msg/TransformStamped", LATCHED_QOS)
        bag.add_topic(TF_STATIC, "tf2_msgs/msg/TFMessage", LATCHED_QOS)
        bag.add_topic(TRUTH, "visualization_msgs/msg/MarkerArray")
        bag.add_topic(POINTS, "sensor_msgs/msg/PointCloud2")
        count, shown, calibration = 0, frozenset(), None
        for scan in scans:
            header = header_message(scan.stamp_ns, LIDAR_FRAME, bag_message)
            if scan.calibration is not None and scan.calibration is not calibration:
                calibration = scan.calibration
                _write_calibration(bag, calibration, scan.stamp_ns, header)
            if scan.truth is not None:
                markers = truth_markers(scan.truth, header, bag_message, shown)
                shown = marker_keys(markers)
                bag.write(TRUTH, scan.stamp_ns, markers)
            if scan.image is not None:
                if IMAGE not in bag.channels:
                    bag.add_topic(IMAGE, "sensor_msgs/msg/CompressedImage")
                camera_header = header_message(scan.stamp_ns, CAMERA_FRAME, bag_message)
                pixels = np.fromfile(scan.image, np.uint8)
                bag.write(IMAGE, scan.stamp_ns, bag_message(
                    "sensor_msgs/msg/CompressedImage", header=camera_header, format="png",
                    data=pixels))
            points = np.ascontiguousarray(scan.cloud, np.float32).view(POINT).reshape(-1)
            bag.write(POINTS, scan.stamp_ns, from_array(points, header, bag_message))
            count += 1
    return count


def _write_calibration(bag: BagWriter, calibration: Calibration, stamp_ns: int,
                       header) -> None:
    camera_header = header_message(stamp_ns, CAMERA_FRAME, bag_message)
    transform = extrinsics(calibration, header, bag_message)
    bag.write(CAMERA_INFO, stamp_ns, camera_info(calibration, camera_header, bag_message))
    bag.write(EXTRINSICS, stamp_ns, transform)
    bag.write(TF_STATIC, stamp_ns, bag_message("tf2_msgs/msg/TFMessage", transforms=[transform]))

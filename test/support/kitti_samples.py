"""KITTI folders in every layout with synthetic scans."""

from __future__ import annotations

import numpy as np
import pytest
from samples import (
    INTRINSICS,
    LIDAR_TO_CAMERA,
    RECTIFY,
    VELODYNE,
    format_numbers,
    make_any_header,
    make_calibration_text,
    make_scene,
    write_file,
    write_object_folder,
)

from lidar_perception.data.kitti.labels import format_label, to_labels
from lidar_perception.types import GroundTruth
from lidar_perception.wire.codec import decode, encode, make_bag_message
from lidar_perception.wire.messages import make_truth_markers, to_truth
from msg_utils.markers import from_marker_array

TRACKING_LABELS = """\
0 3 Pedestrian 0 1 -0.210000 700.000000 150.000000 800.000000 300.000000 1.800000 0.500000 \
0.900000 1.500000 1.600000 8.000000 0.020000
0 -1 DontCare -1 -1 -10.000000 235.780000 179.580000 276.180000 231.170000 -1000.000000 \
-1000.000000 -1000.000000 -10.000000 -1.000000 -1.000000 -1.000000
2 4 Person 1 0 1.570000 10.250000 180.500000 220.750000 374.000000 1.200000 0.630000 \
0.880000 -5.100000 1.710000 9.430000 1.050000
"""
TRACKLETS = """\
<?xml version="1.0"?>
<boost_serialization><tracklets class_id="0"><count>2</count><item_version>1</item_version>
<item><objectType>Pedestrian</objectType><h>1.8</h><w>0.5</w><l>0.9</l>
  <first_frame>1</first_frame><poses><count>2</count><item_version>2</item_version>
    <item><tx>8</tx><ty>-1</ty><tz>-1.7</tz><rz>0.5</rz><occlusion>1</occlusion>
      <truncation>0</truncation></item>
    <item><tx>9</tx><ty>-1</ty><tz>-1.7</tz><rz>0.6</rz></item></poses></item>
<item><objectType>Person (sitting)</objectType><h>1.2</h><w>0.6</w><l>0.8</l>
  <first_frame>2</first_frame><poses>
    <item><tx>5</tx><ty>2</ty><tz>-1.6</tz><rz>-3</rz></item></poses></item>
</tracklets></boost_serialization>
"""


def write_tracking_folder(root):
    for sequence, frames in (("0000", (0, 1, 2)), ("0007", (5, 6))):
        for i in frames:
            write_file(root / f"training/velodyne/{sequence}/{i:06}.bin", make_scene(i).tobytes())
        write_file(
            root / f"training/calib/{sequence}.txt", make_calibration_text("R_rect", "Tr_velo_cam")
        )  # without colons, as in KITTI's files
    write_file(root / "training/label_02/0000.txt", TRACKING_LABELS)
    return root


def write_raw_folder(root):
    day = root / "2011_09_26"
    drive = day / "2011_09_26_drive_0001_sync"
    for i in range(3):
        write_file(drive / f"velodyne_points/data/{i:010}.bin", make_scene(i).tobytes())
    write_file(
        drive / "velodyne_points/timestamps.txt",
        "2011-09-26 13:02:25.594360375\n2011-09-26 13:02:25.7\n2011-09-26 13:02:26.000000001\n",
    )
    write_file(drive / "tracklet_labels.xml", TRACKLETS)
    write_file(
        day / "calib_cam_to_cam.txt",
        "calib_time: 09-Jan-2012 13:57:47\n"
        f"S_rect_02: 1.242e+03 3.75e+02\nR_rect_00: {format_numbers(RECTIFY)}\n"
        f"P_rect_02: {format_numbers(INTRINSICS)}\n",
    )
    write_file(
        day / "calib_velo_to_cam.txt",
        "calib_time: 15-Mar-2012 11:37:16\n"
        f"R: {format_numbers(VELODYNE[:, :3])}\nT: {format_numbers(VELODYNE[:, 3])}\ndelta_f: 0 0\n",
    )
    return root


LAYOUTS = {"object": write_object_folder, "tracking": write_tracking_folder, "raw": write_raw_folder}
each_layout = pytest.mark.parametrize("layout", LAYOUTS)


def format_truth(truth: GroundTruth) -> list[str]:
    return [format_label(label) for label in to_labels(truth, LIDAR_TO_CAMERA)]


def pass_through_markers(truth: GroundTruth) -> GroundTruth:
    raw = encode(make_truth_markers(truth, make_any_header(make_bag_message), make_bag_message))
    return to_truth(from_marker_array(decode(raw, "visualization_msgs/msg/MarkerArray")))


def are_equal_truths(a: GroundTruth, b: GroundTruth) -> bool:
    yaw_difference = np.abs((a.boxes[:, 6] - b.boxes[:, 6] + np.pi) % (2 * np.pi) - np.pi)
    return (
        np.array_equal(a.boxes[:, :6], b.boxes[:, :6])
        and bool((yaw_difference < 1e-12).all())
        and a.labels == b.labels
        and a.extras == b.extras
        and a.notes == b.notes
    )

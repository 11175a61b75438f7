"""Conversion of every kind of cloud message to PointCloud2."""

from __future__ import annotations

import re

import numpy as np
import pytest
from cloud_samples import COMPRESS, compressed_message, livox_message, livox_points
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from samples import STAMP

from lidar_perception.types import InputError
from lidar_perception.wire import compression
from lidar_perception.wire.clouds import (
    COMPRESSED,
    LIVOX,
    POINT_CLOUD,
    check_readable,
    decode_cloud,
    diagnose_packets,
    find_cloud_topics,
)
from lidar_perception.wire.codec import MORE_TYPES, encode, load_typestore
from lidar_perception.wire.livox import convert_livox_ros1_to_cdr
from lidar_perception.wire.messages import to_point_cloud
from lidar_perception.wire.point_times import read_point_times
from msg_utils.point_cloud2 import to_array
from msg_utils.stamps import to_ns


def same_points(cloud, points):
    read = to_array(cloud)
    return set(read.dtype.names) == {*points} and all(np.array_equal(read[name], points[name]) for name in points)


@pytest.mark.parametrize("kind", LIVOX)
@pytest.mark.parametrize("frame_id", ["", "l", "livox", "livox_fram", "livox_frame"])
@pytest.mark.parametrize("count", [0, 1, 5])
def test_livox_message_keeps_all_columns(kind, frame_id, count):
    points = livox_points(count)
    data = encode(livox_message(points, kind.partition("/")[0], frame_id=frame_id))
    for tail in b"", b"\0\0\0":
        cloud = decode_cloud(data + tail, kind)
        assert same_points(cloud, points)
        assert (to_ns(cloud.header.stamp), cloud.header.frame_id) == (STAMP, frame_id)


def test_big_endian_livox_message_is_read():
    points, kind = livox_points(), LIVOX[1]
    data = bytes(load_typestore().serialize_cdr(livox_message(points), kind, little_endian=False))
    assert same_points(decode_cloud(data, kind), points)


def test_livox_cloud_has_intensity_and_times():
    points = livox_points(7)
    cloud = decode_cloud(encode(livox_message(points)), LIVOX[1])
    frame, indices = to_point_cloud(cloud, 0.0)
    np.testing.assert_allclose(frame.intensity, points["reflectivity"] / 255, atol=1e-6)
    times = read_point_times(cloud, indices)
    np.testing.assert_allclose(times.seconds, points["offset_time"] * 1e-9, atol=1e-12)


@pytest.mark.parametrize("frame_id", ["", "livox_frame"])
@pytest.mark.parametrize("count", [0, 1, 5])
def test_livox_message_of_ros1_equals_that_of_ros2(frame_id, count):
    store = get_typestore(Stores.ROS1_NOETIC)
    for name, text in MORE_TYPES.items():
        if name.startswith("livox"):
            store.register(get_types_from_msg(text, name))
    points = livox_points(count)
    message = livox_message(points, frame_id=frame_id)
    head = store.types["std_msgs/msg/Header"](seq=7, stamp=message.header.stamp, frame_id=frame_id)
    vars(message)["header"] = head
    data = bytes(store.serialize_ros1(message, LIVOX[1]))
    vars(message)["header"] = livox_message(points, frame_id=frame_id).header
    cdr = convert_livox_ros1_to_cdr(data)
    assert cdr.rstrip(b"\0") == encode(message).rstrip(b"\0")
    assert same_points(decode_cloud(cdr, LIVOX[1]), points)


@pytest.mark.parametrize("cut", [0, 1, 5, 17, 40, 60, 100])
def test_truncated_livox_message_is_reported(cut):
    data = encode(livox_message(livox_points()))
    with pytest.raises(InputError, match="Livox CustomMsg") as error:
        decode_cloud(data[:cut], LIVOX[1])
    assert "\n" not in str(error.value)


POINTS = np.arange(40, dtype=np.float32).view([(name, "<f4") for name in "xyzi"])


@pytest.mark.parametrize("packing", ["zlib", "gzip", "zstd"])
def test_compressed_clouds_are_decompressed(packing):
    for points in POINTS, POINTS[:0]:
        message = compressed_message(points, packing)
        data = encode(message)
        check_readable(data, COMPRESSED)
        cloud = decode_cloud(data, COMPRESSED)
        assert to_array(cloud).tobytes() == points.tobytes()
        assert cloud.__msgtype__ == POINT_CLOUD and to_ns(cloud.header.stamp) == STAMP


@pytest.mark.parametrize(
    "packing, words",
    [
        ("draco", "compression 'draco' is not supported, only zlib and zstd: .*in_transport:=draco"),
        ("", "compression '' is not supported"),
    ],
)
def test_unsupported_compression_is_reported(packing, words):
    message = compressed_message(POINTS, "draco")
    vars(message)["format"] = packing
    for read in decode_cloud, check_readable:
        with pytest.raises(InputError, match=words):
            read(encode(message), COMPRESSED)


@pytest.mark.parametrize("packing", ["zlib", "zstd"])
def test_damaged_or_huge_compressed_cloud_is_reported(packing, monkeypatch):
    monkeypatch.setattr(compression, "MAX_BYTES", 1000)
    message = compressed_message(POINTS, packing)
    for content in message.compressed_data[:-9].tobytes(), b"text", COMPRESS[packing](bytes(1001)):
        vars(message)["compressed_data"] = np.frombuffer(content, np.uint8)
        with pytest.raises(InputError, match=f"{packing}-compressed cloud is damaged|is truncated"):
            to_point_cloud(decode_cloud(encode(message), COMPRESSED))


def test_compressed_copy_of_a_topic_is_ignored():
    topics = {
        "/a": POINT_CLOUD,
        "/a/zlib": COMPRESSED,
        "/b/zstd": COMPRESSED,
        "/c": LIVOX[0],
        "/d": "std_msgs/msg/String",
    }
    assert find_cloud_topics(topics) == ["/a", "/b/zstd", "/c"]


@pytest.mark.parametrize(
    "kind, words",
    [
        ("velodyne_msgs/msg/VelodyneScan", "VelodyneScan on /x .*raw sensor packets.*velodyne_pointcloud"),
        ("velodyne_msgs/VelodyneScan", "velodyne_pointcloud"),
        ("ouster_sensor_msgs/msg/PacketMsg", "ouster_ros"),
        ("nebula_msgs/msg/NebulaPackets", "nebula_ros"),
        ("rslidar_msg/msg/RslidarPacket", "rslidar_sdk"),
        ("sensor_msgs/msg/LaserScan", "laser_geometry"),
        ("sensor_msgs/msg/PointCloud", "point_cloud_converter"),
    ],
)
def test_sensor_packets_are_reported_with_their_driver(kind, words):
    problem = diagnose_packets({"/note": "std_msgs/msg/String", "/x": kind})
    assert re.search(words, problem) and "\n" not in problem
    assert diagnose_packets({"/x": POINT_CLOUD, "/note": "std_msgs/msg/String"}) is None

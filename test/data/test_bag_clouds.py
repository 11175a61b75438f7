"""Bags of other sensor messages: Livox and compressed clouds."""

from __future__ import annotations

import numpy as np
import pytest
from bag_samples import as_ros1
from cloud_samples import compressed_message, livox_message, livox_points
from mcap.writer import Writer
from samples import STAMP

from lidar_perception.data.bag import BagWriter
from lidar_perception.data.open import open_recording
from lidar_perception.data.raw_clouds import open_clouds
from lidar_perception.data.to_bag import write_bag
from lidar_perception.types import InputError
from lidar_perception.wire.clouds import COMPRESSED, LIVOX
from lidar_perception.wire.codec import encode
from lidar_perception.wire.point_times import read_point_times


def write_clouds(path, topic, kind, messages):
    with BagWriter(path) as bag:
        bag.add_topic(topic, kind)
        for i, message in enumerate(messages):
            bag.write(topic, STAMP + i, message)
    return path


@pytest.mark.parametrize("kind", LIVOX)
@pytest.mark.parametrize("ros", [1, 2])
def test_livox_bag_has_intensity_and_point_times(tmp_path, kind, ros):
    points = livox_points(50)
    path = write_clouds(
        tmp_path / "bag",
        "/livox/lidar",
        kind,
        [livox_message(points, kind.partition("/")[0], STAMP + i * 10**8) for i in range(3)],
    )
    if ros == 1:
        path = as_ros1(path, tmp_path / "livox.bag")
    recording = open_recording(path)
    assert "clouds on /livox/lidar" in str(recording)
    assert [frame.stamp_ns for frame in recording] == [STAMP + i * 10**8 for i in range(3)]
    frame = recording.frames[2].load()
    np.testing.assert_array_equal(frame.xyz, np.column_stack([points[axis] for axis in "xyz"]))
    np.testing.assert_allclose(frame.intensity, points["reflectivity"] / 255, atol=1e-6)
    clouds = open_clouds(path)
    times = read_point_times(clouds.load(1), np.arange(50)).seconds
    np.testing.assert_allclose(times, points["offset_time"] * 1e-9, atol=1e-12)
    write_bag(tmp_path / "converted", recording)
    assert np.array_equal(open_recording(tmp_path / "converted").frames[2].load().xyz, frame.xyz)


@pytest.mark.parametrize("packing", ["zlib", "zstd"])
def test_compressed_clouds_are_read(tmp_path, packing):
    points = np.arange(40, dtype=np.float32).view([(name, "<f4") for name in "xyzi"])
    path = write_clouds(tmp_path / "bag", f"/points/{packing}", COMPRESSED, [compressed_message(points, packing)] * 2)
    first, second = open_recording(path)
    assert np.array_equal(first.load().xyz, second.load().xyz) and len(first.load()) == 10


@pytest.mark.parametrize(
    "kind, words",
    [
        (COMPRESSED, "compression .draco. is not supported"),
        ("sensor_msgs/msg/LaserScan", "LaserScan on /scan cannot be read"),
        ("velodyne_msgs/msg/VelodyneScan", "VelodyneScan on /scan .*play the bag to velodyne"),
    ],
)
@pytest.mark.parametrize("points", ["", "/scan"])
def test_unsupported_sensor_data_is_reported_with_remedy(tmp_path, kind, words, points):
    message = b"\0\1\0\0" + bytes(60)
    if kind == COMPRESSED:
        message = encode(compressed_message(np.zeros(1, [("x", "<f4")]), "draco"))
    with open(tmp_path / "a.mcap", "wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        channel = writer.register_channel("/scan", "cdr", writer.register_schema(kind, "ros2msg", b""))
        writer.add_message(channel, 1, message, 1)
        writer.finish()
    with pytest.raises(InputError, match=rf"a\.mcap.*{words}") as error:
        open_recording(tmp_path / "a.mcap", points=points)
    assert "\n" not in str(error.value)

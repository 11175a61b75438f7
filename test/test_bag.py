"""Bags: what was written is read, by us and by others, and damage is named."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from samples import (
    CALIBRATION,
    STAMP,
    each_make,
    header,
    png_header,
    scene,
    walker_truth,
    write,
)

from lidar_perception.camera import Camera
from lidar_perception.datasets.bag import (
    LATCHED_QOS,
    Bag,
    BagWriter,
    bag_message,
    decode,
    encode,
    typestore,
)
from lidar_perception.datasets.kitti_calibration import KittiCalibration
from lidar_perception.datasets.recording import open_recording
from lidar_perception.datasets.to_bag import Scan, write_bag
from lidar_perception.messages import camera_info, camera_of, detection_markers, extrinsics
from lidar_perception.topics import (
    CAMERA_INFO,
    EXTRINSICS,
    IMAGE,
    POINTS,
    TF_STATIC,
    TRUTH,
)
from lidar_perception.types import Detections, GroundTruth, InputError
from msg_utils.messages import message_class, ros_message
from msg_utils.point_cloud2 import from_array, to_array

OTHER_CALIBRATION = KittiCalibration(CALIBRATION.intrinsics * [[2], [2], [1]],
                                     CALIBRATION.lidar_to_camera, 640, 480)
LATCHED = {CAMERA_INFO, EXTRINSICS, TF_STATIC}


def scans(count: int = 3) -> list[Scan]:
    """Truth in all but the second; the calibration changes after the second."""
    return [Scan(scene(i), STAMP + i * 10**8, None if i == 1 else walker_truth(),
                 CALIBRATION if i < 2 else OTHER_CALIBRATION) for i in range(count)]


def message_bytes(path) -> list[tuple[str, int, bytes]]:
    with Bag(path) as bag:
        return list(bag.raw())


def same_cloud(cloud: np.ndarray, xyz: np.ndarray) -> bool:
    return cloud[:, :3].tobytes() == xyz.tobytes()


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("bags") / "drive"
    assert write_bag(path, scans()) == 3
    return path


def test_a_recording_gives_back_the_scans(written):
    recording = open_recording(bag=written)
    assert recording.count == 3
    for scan, read in zip(scans(), recording, strict=True):
        assert same_cloud(scan.cloud, read.frame.xyz)
        assert (read.frame.stamp_ns, read.frame.frame_id) == (scan.stamp_ns, "velodyne")
        assert (read.truth is None) == (scan.truth is None)
        if scan.truth is not None:
            np.testing.assert_allclose(read.truth.boxes, scan.truth.boxes, atol=1e-12)
            assert read.truth.labels == scan.truth.labels
        np.testing.assert_allclose(read.camera.projection, scan.calibration.camera().projection,
                                   atol=1e-9)
        assert (read.camera.width, read.camera.height) == (scan.calibration.width,
                                                           scan.calibration.height)


def test_clouds_are_in_the_bag_bit_by_bit_with_intensity(tmp_path):
    cloud = np.array([[1, 2, 3, 0.5], [np.nan, -0.0, np.inf, -1], [0, 0, 0, 0]], np.float32)
    write_bag(tmp_path / "bag", [Scan(cloud, STAMP), Scan(cloud[:0], STAMP + 1)])
    with Bag(tmp_path / "bag") as bag:
        full, empty = [to_array(msg) for _, _, msg in bag.messages({POINTS})]
    assert full.dtype.names == ("x", "y", "z", "intensity") and len(empty) == 0
    assert full.tobytes() == cloud.tobytes()


def test_what_a_scan_lacks_is_not_in_the_bag(tmp_path):
    write_bag(tmp_path / "bag", [Scan(scene(), STAMP)])
    read, = open_recording(bag=tmp_path / "bag")
    assert read.truth is None and read.camera is None
    with Bag(tmp_path / "bag") as bag:
        assert {t for t, _, _ in bag.raw()} == {POINTS}


def test_empty_labels_are_not_missing_labels(tmp_path):
    write_bag(tmp_path / "bag", [Scan(scene(), STAMP, GroundTruth.of([], []))])
    read, = open_recording(bag=tmp_path / "bag")
    assert len(read.truth) == 0


def test_images_are_in_the_bag_byte_by_byte(tmp_path):
    image = write(tmp_path / "image.png", png_header(3, 2) + b"pixels")
    write_bag(tmp_path / "bag", [Scan(scene(), STAMP, image=image)])
    with Bag(tmp_path / "bag") as bag:
        (_, stamp, msg), = bag.messages({IMAGE})
    assert (bytes(msg.data), msg.format, stamp) == (image.read_bytes(), "png", STAMP)


def test_a_calibration_is_written_when_it_changes_and_before_its_cloud(written):
    order = [(t, s) for t, s, _ in message_bytes(written)]
    for topic in LATCHED:
        assert [s for t, s in order if t == topic] == [STAMP, STAMP + 2 * 10**8]
    for stamp in (STAMP, STAMP + 2 * 10**8):
        assert order.index((CAMERA_INFO, stamp)) < order.index((POINTS, stamp))


def test_rosbags_reads_the_bag(written):
    with AnyReader([written]) as reader:
        got = [(c.topic, s, bytes(data)) for c, s, data in reader.messages()]
        types = {c.topic: c.msgtype for c in reader.connections}
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
    assert got == message_bytes(written)
    assert types[POINTS] == "sensor_msgs/msg/PointCloud2"


def test_mcap_reads_the_bag_and_its_checksums_hold(written):
    with open(written / "drive.mcap", "rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        got = [(channel.topic, m.log_time, m.data, channel.message_encoding, schema.encoding)
               for schema, channel, m in reader.iter_messages(log_time_order=False)]
        assert reader.get_header().profile == "ros2"
    assert sorted(got) == sorted((*row, "cdr", "ros2msg") for row in message_bytes(written))


def test_chunks_are_zstd_and_hold_more_than_one_cloud(tmp_path):
    cloud = np.random.default_rng(0).random((60_000, 4), np.float32)
    count = write_bag(tmp_path / "bag", (Scan(cloud, STAMP + i) for i in range(12)))
    with open(tmp_path / "bag/bag.mcap", "rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    assert {c.compression for c in chunks} == {"zstd"}
    assert 1 < len(chunks) < count / 2


def test_calibrations_are_latched_and_clouds_are_not(written):
    with Bag(written) as bag:
        for topic in bag.topics:
            quality, = bag.qos(topic)
            latched = quality.durability.name == "TRANSIENT_LOCAL"
            assert latched == (topic in LATCHED)
            assert quality.reliability.name == "RELIABLE"
    with open(written / "drive.mcap", "rb") as stream:
        channels = make_reader(stream).get_summary().channels.values()
    for channel in channels:
        quality, = yaml.safe_load(channel.metadata["offered_qos_profiles"])
        assert (quality["durability"] == "transient_local") == (channel.topic in LATCHED)


def test_metadata_counts_what_is_in_the_file(written):
    info = yaml.safe_load((written / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    rows = message_bytes(written)
    counts = {t["topic_metadata"]["name"]: t["message_count"]
              for t in info["topics_with_message_count"]}
    assert counts == {topic: sum(t == topic for t, _, _ in rows) for topic in counts}
    assert counts[POINTS] == 3 and counts[TRUTH] == 2 and IMAGE not in counts
    assert info["message_count"] == len(rows)
    assert info["starting_time"]["nanoseconds_since_epoch"] == min(s for _, s, _ in rows)
    assert info["duration"]["nanoseconds"] == max(s for _, s, _ in rows) - STAMP
    assert info["relative_file_paths"] == ["drive.mcap"]
    with Bag(written) as bag:
        assert (bag.start_ns, bag.counts) == (STAMP, counts)


def test_a_bag_without_messages_is_a_bag(tmp_path):
    assert write_bag(tmp_path / "bag", []) == 0
    assert list(open_recording(bag=tmp_path / "bag")) == []


def test_an_existing_bag_is_replaced_only_by_force(tmp_path):
    path = tmp_path / "bag"
    write_bag(path, scans(1))
    before = message_bytes(path)
    with pytest.raises(InputError, match=r"exists already.*--force"):
        write_bag(path, scans(2))
    assert message_bytes(path) == before
    write_bag(path, scans(2), force=True)
    assert open_recording(bag=path).count == 2


@pytest.mark.parametrize("make", [lambda p: write(p / "bag", b"text"),
                                  lambda p: write(p / "bag/notes.txt", b"text")])
def test_force_replaces_nothing_but_bags(tmp_path, make):
    kept = make(tmp_path)
    with pytest.raises(InputError, match="is no bag"):
        write_bag(tmp_path / "bag", scans(1), force=True)
    assert kept.read_bytes() == b"text"


@pytest.mark.parametrize("force", [False, True])
def test_an_exception_leaves_the_old_bag_and_an_incomplete_one_that_can_be_read(tmp_path, force):
    path = tmp_path / "bag"
    if force:
        write_bag(path, scans(1))
    before = message_bytes(path) if force else None

    def failing():
        yield from scans(2)
        raise RuntimeError("power cut")

    with pytest.raises(RuntimeError, match="power cut"):
        write_bag(path, failing(), force=force)
    assert len(list(open_recording(bag=tmp_path / "bag.incomplete"))) == 2
    assert (message_bytes(path) == before) if force else not path.exists()
    write_bag(path, scans(3), force=force)  # what is left over is no obstacle
    assert open_recording(bag=path).count == 3
    assert not (tmp_path / "bag.incomplete").exists()


def test_a_place_that_cannot_hold_a_bag_is_named(tmp_path):
    write(tmp_path / "file", b"")
    with pytest.raises(InputError, match=r"cannot write the bag .*file/bag"):
        write_bag(tmp_path / "file/bag", scans(1))


def test_a_folder_without_metadata_is_read_by_its_one_file(written, tmp_path):
    shutil.copy(written / "drive.mcap", tmp_path)
    assert message_bytes(tmp_path) == message_bytes(written)
    assert message_bytes(tmp_path / "drive.mcap") == message_bytes(written)
    shutil.copy(written / "drive.mcap", tmp_path / "second.mcap")
    with pytest.raises(InputError, match=r"no metadata\.yaml and 2 storage files"):
        Bag(tmp_path)


@pytest.mark.parametrize("name, make, words", [
    ("missing", lambda p: None, "there is no bag"),
    ("folder", lambda p: p.mkdir(), "no metadata.yaml and 0 storage files"),
    ("cloud.bin", lambda p: write(p, b"1234"), "is no rosbag2 bag"),
    ("empty.mcap", lambda p: write(p, b""), "truncated or damaged"),
    ("text.mcap", lambda p: write(p, b"text " * 100), "truncated or damaged"),
    ("text.db3", lambda p: write(p, b"text " * 100), "truncated or damaged"),
    ("bag", lambda p: write(p / "metadata.yaml", "text"), "truncated or damaged"),
    ("bag", lambda p: write(p / "metadata.yaml", "a: [\n"), "truncated or damaged"),
])
def test_what_is_no_bag_is_named_in_one_line(tmp_path, name, make, words):
    make(tmp_path / name)
    with pytest.raises(InputError) as error:
        Bag(tmp_path / name)
    assert str(tmp_path / name) in str(error.value) and words in str(error.value)
    assert "\n" not in str(error.value)


def test_a_bag_without_its_file_is_damaged(written, tmp_path):
    shutil.copy(written / "metadata.yaml", tmp_path)
    with pytest.raises(InputError, match="truncated or damaged"):
        message_bytes(tmp_path)


@pytest.mark.parametrize("folder", [True, False])
def test_a_bag_that_was_cut_anywhere_is_damaged(written, tmp_path, folder):
    raw = (written / "drive.mcap").read_bytes()
    if folder:
        shutil.copy(written / "metadata.yaml", tmp_path)
    path = tmp_path / "drive.mcap"
    for size in [*range(0, len(raw), 9973), *range(len(raw) - 12, len(raw))]:
        path.write_bytes(raw[:size])
        with pytest.raises(InputError, match="truncated or damaged"):
            message_bytes(tmp_path if folder else path)


def test_a_byte_that_flipped_is_never_a_traceback(written, tmp_path):
    raw = (written / "drive.mcap").read_bytes()
    with open(written / "drive.mcap", "rb") as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[0].chunk_start_offset
    damaged, path = 0, tmp_path / "drive.mcap"
    for at in [*range(chunk, chunk + 100), *range(0, len(raw), len(raw) // 30)]:
        path.write_bytes(raw[:at] + bytes([raw[at] ^ 0x55]) + raw[at + 1:])
        try:
            with Bag(path) as bag:
                list(bag.messages(bag.topics))
        except InputError as error:
            damaged += 1
            assert "\n" not in str(error)
    assert damaged > 40


def test_a_bag_without_clouds_says_what_it_has(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/text", "std_msgs/msg/String")
        bag.write("/text", 1, bag_message("std_msgs/msg/String", data="hello"))
    with pytest.raises(InputError) as error:
        open_recording(bag=tmp_path / "bag")
    for word in (str(tmp_path / "bag"), "no topic /points", "/text (std_msgs/msg/String)"):
        assert word in str(error.value)


def test_a_cloud_that_cannot_be_used_leaves_the_others(tmp_path):
    cloud = scene()[:, :2].copy().view([("x", "<f4"), ("y", "<f4")]).reshape(-1)
    write_bag(tmp_path / "bag", scans(1))
    with BagWriter(tmp_path / "mixed") as bag:
        bag.add_topic(POINTS, "sensor_msgs/msg/PointCloud2")
        bag.write(POINTS, 1, from_array(cloud, header(bag_message, 1), bag_message))
        for topic, _, data in message_bytes(tmp_path / "bag"):
            if topic == POINTS:
                bag.write(POINTS, 2, data)
    flat, good = open_recording(bag=tmp_path / "mixed")
    assert isinstance(flat, InputError) and "no field 'z'" in str(flat)
    assert same_cloud(scene(), good.frame.xyz)


def test_bags_of_sqlite_are_read_alike(written, tmp_path):
    with Writer(tmp_path / "sql", version=9, storage_plugin=StoragePlugin.SQLITE3) as bag, \
            Reader(written) as reader:
        copies = {c.topic: bag.add_connection(c.topic, c.msgtype, typestore=typestore())
                  for c in reader.connections}
        for connection, stamp, data in reader.messages():
            bag.write(copies[connection.topic], stamp, data)
    for a, b in zip(open_recording(bag=written), open_recording(bag=tmp_path / "sql"),
                    strict=True):
        assert same_cloud(a.frame.xyz, b.frame.xyz)
        assert np.array_equal(a.camera.projection, b.camera.projection)
        assert (a.truth is None) == (b.truth is None)


def test_raw_takes_topics_and_a_window_of_time(written):
    rows = message_bytes(written)
    with Bag(written) as bag:
        assert list(bag.raw({POINTS, TRUTH})) == [r for r in rows if r[0] in (POINTS, TRUTH)]
        assert list(bag.raw(set())) == []
        low, high = STAMP + 1, STAMP + 2 * 10**8
        assert list(bag.raw(None, low, high)) == [r for r in rows if low <= r[1] < high]


def test_labels_may_come_after_their_cloud(written, tmp_path):
    with BagWriter(tmp_path / "late") as bag:
        bag.add_topic(POINTS, "sensor_msgs/msg/PointCloud2")
        bag.add_topic(TRUTH, "visualization_msgs/msg/MarkerArray")
        bag.add_topic(CAMERA_INFO, "sensor_msgs/msg/CameraInfo", LATCHED_QOS)
        bag.add_topic(EXTRINSICS, "geometry_msgs/msg/TransformStamped", LATCHED_QOS)
        for topic, stamp, data in message_bytes(written):
            if topic in bag.channels:
                bag.write(topic, stamp + (topic != POINTS) * 5 * 10**7, data)
    read = list(open_recording(bag=tmp_path / "late"))
    assert [r.truth is not None for r in read] == [True, False, True]
    assert all(r.camera is not None for r in read)


@each_make
def test_the_camera_is_the_same_from_either_direction_of_the_transform(make):
    info = camera_info(CALIBRATION, header(make, frame_id="camera"), make)
    forth = extrinsics(CALIBRATION, header(make), make)
    back = extrinsics(CALIBRATION, header(make, frame_id="camera"), make)
    back.child_frame_id = "velodyne"
    inverse = np.linalg.inv(CALIBRATION.lidar_to_camera)
    turned = KittiCalibration(CALIBRATION.intrinsics, inverse, 1, 1).pose
    q, t = back.transform.rotation, back.transform.translation
    (q.x, q.y, q.z, q.w), (t.x, t.y, t.z) = (map(float, v) for v in turned)
    expected = CALIBRATION.intrinsics @ CALIBRATION.lidar_to_camera
    for transform in (forth, back):
        camera = camera_of(info, transform)
        np.testing.assert_allclose(camera.projection, expected, atol=1e-9)
        assert (camera.width, camera.height) == (1242, 375)


@each_make
@pytest.mark.parametrize("change, words", [
    (lambda info, tf: setattr(info.header, "frame_id", "rear"),
     "'rear' but the transform links 'velodyne' and 'camera'"),
    (lambda info, tf: setattr(info, "width", 0), "no image size"),
    (lambda info, tf: setattr(info, "p", np.zeros(12)), "no projection matrix"),
    (lambda info, tf: setattr(tf.transform.rotation, "w", 5.0), "no unit quaternion"),
    (lambda info, tf: setattr(tf.transform.rotation, "w", float("nan")), "no unit quaternion"),
])
def test_a_camera_that_cannot_be_used_is_an_input_error(make, change, words):
    info = camera_info(CALIBRATION, header(make, frame_id="camera"), make)
    transform = extrinsics(CALIBRATION, header(make), make)
    change(info, transform)
    with pytest.raises(InputError, match=words):
        camera_of(info, transform)


def test_a_point_is_in_view_where_its_pixel_is_in_the_image():
    camera = Camera(np.array([[10.0, 0, 50, 0], [0, 10, 20, 0], [0, 0, 1, 0]]), 100, 40)
    points = np.array([[0, 0, 1], [0, 0, -1], [-5.01, 0, 1], [4.99, 0, 1], [5.01, 0, 1],
                       [0, 1.99, 1], [0, 2.01, 1], [0, -2.01, 1]], np.float32)
    assert camera.in_view(points).tolist() == [True, False, False, True, False, True, False, False]


MESSAGES = {
    "cloud": lambda make: from_array(
        np.arange(24, dtype="<f4").view([("x", "<f4"), ("", "V4"), ("y", "<f4"), ("z", "<f4")])[
            ["x", "y", "z"]], header(make), make, height=2),
    "no points": lambda make: from_array(np.zeros(0, [("x", "<f4")]), header(make), make),
    "markers": lambda make: detection_markers(
        Detections.of([[1, 2, 3, 4, 5, 6, 0.5]] * 2, [3, 0], [0.25, 1]), header(make), make,
        {("Car", 9)}),
    "camera": lambda make: camera_info(CALIBRATION, header(make), make),
    "transform": lambda make: extrinsics(CALIBRATION, header(make), make),
}


@pytest.mark.parametrize("build", MESSAGES.values(), ids=MESSAGES)
def test_ros_and_rosbags_read_each_others_bytes(build):
    serialization = pytest.importorskip("rclpy.serialization", reason="needs rclpy")
    ours, theirs = build(bag_message), build(ros_message)
    name = ours.__msgtype__
    raw = serialization.serialize_message(theirs)
    as_ros = message_class(name)
    assert serialization.deserialize_message(
        encode(ours), as_ros) == serialization.deserialize_message(raw, as_ros)
    assert encode(decode(raw, name)) == encode(ours)


@pytest.mark.parametrize("name", ["sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/Pose",
                                  "sensor_msgs/msg/CameraInfo", "visualization_msgs/msg/Marker",
                                  "diagnostic_msgs/msg/DiagnosticArray"])
def test_a_message_without_fields_is_all_zero_as_in_ros(name):
    serialization = pytest.importorskip("rclpy.serialization", reason="needs rclpy")
    theirs = ros_message(name)
    if name.endswith(("Pose", "Marker")):  # ROS starts at the unit quaternion
        pose = theirs if name.endswith("Pose") else theirs.pose
        pose.orientation.w = 0.0
    got = serialization.deserialize_message(encode(bag_message(name)), message_class(name))
    assert got == theirs


def test_a_field_that_is_not_there_is_a_type_error():
    with pytest.raises(TypeError, match="has no field 'colour'"):
        bag_message("visualization_msgs/msg/Marker", colour=1)


def test_bytes_that_are_no_message_are_an_input_error():
    raw = encode(MESSAGES["markers"](bag_message))
    for size in range(0, len(raw), 7):
        with pytest.raises(InputError, match=f"^{size} bytes are no visualization_msgs"):
            decode(raw[:size], "visualization_msgs/msg/MarkerArray")

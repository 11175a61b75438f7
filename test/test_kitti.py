"""KITTI folders: every layout is read in full, labels come back as they were, and what is
missing is named."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import (
    AXES,
    CALIBRATION,
    INTRINSICS,
    LABELS,
    LIDAR_TO_CAMERA,
    RECTIFY,
    VELODYNE,
    calibration_text,
    header,
    numbers,
    object_folder,
    png_header,
    scene,
    write,
)

from lidar_perception.datasets.bag import bag_message, decode, encode
from lidar_perception.datasets.kitti import START_NS, open_kitti, read_velodyne
from lidar_perception.datasets.kitti_calibration import IMAGE_SIZES, read_calibration
from lidar_perception.datasets.kitti_labels import (
    format_label,
    parse,
    read_object_labels,
    read_tracking_labels,
    to_ground_truth,
    to_labels,
)
from lidar_perception.datasets.recording import open_recording
from lidar_perception.datasets.to_bag import kitti_scan
from lidar_perception.geometry import box_corners
from lidar_perception.messages import to_truth, truth_markers
from lidar_perception.types import CLASSES, GroundTruth, InputError
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


def tracking_folder(root):
    for sequence, frames in (("0000", (0, 1, 2)), ("0007", (5, 6))):
        for i in frames:
            write(root / f"training/velodyne/{sequence}/{i:06}.bin", scene(i).tobytes())
        write(root / f"training/calib/{sequence}.txt",
              calibration_text("R_rect", "Tr_velo_cam"))  # without colons, as it comes
    write(root / "training/label_02/0000.txt", TRACKING_LABELS)
    return root


def raw_folder(root):
    day = root / "2011_09_26"
    drive = day / "2011_09_26_drive_0001_sync"
    for i in range(3):
        write(drive / f"velodyne_points/data/{i:010}.bin", scene(i).tobytes())
    write(drive / "velodyne_points/timestamps.txt",
          "2011-09-26 13:02:25.594360375\n2011-09-26 13:02:25.7\n2011-09-26 13:02:26.000000001\n")
    write(drive / "tracklet_labels.xml", TRACKLETS)
    write(day / "calib_cam_to_cam.txt", "calib_time: 09-Jan-2012 13:57:47\n"
          f"S_rect_02: 1.242e+03 3.75e+02\nR_rect_00: {numbers(RECTIFY)}\n"
          f"P_rect_02: {numbers(INTRINSICS)}\n")
    write(day / "calib_velo_to_cam.txt", "calib_time: 15-Mar-2012 11:37:16\n"
          f"R: {numbers(VELODYNE[:, :3])}\nT: {numbers(VELODYNE[:, 3])}\ndelta_f: 0 0\n")
    return root


LAYOUTS = {"object": object_folder, "tracking": tracking_folder, "raw": raw_folder}
each_layout = pytest.mark.parametrize("layout", LAYOUTS)


def text_of(truth: GroundTruth) -> list[str]:
    return [format_label(label) for label in to_labels(truth, LIDAR_TO_CAMERA)]


def over_the_wire(truth: GroundTruth) -> GroundTruth:
    raw = encode(truth_markers(truth, header(bag_message), bag_message))
    return to_truth(from_marker_array(decode(raw, "visualization_msgs/msg/MarkerArray")))


def same(a: GroundTruth, b: GroundTruth) -> bool:
    turned = np.abs((a.boxes[:, 6] - b.boxes[:, 6] + np.pi) % (2 * np.pi) - np.pi)
    return (np.array_equal(a.boxes[:, :6], b.boxes[:, :6]) and bool((turned < 1e-12).all())
            and a.labels == b.labels and a.extras == b.extras and a.notes == b.notes)


def hundredths(low: int, high: int):
    return st.integers(low, high).map(lambda n: f"{n / 100:.2f}")


@st.composite
def label_lines(draw) -> str:
    if draw(st.booleans()):
        bbox = [draw(hundredths(0, 120000)) for _ in range(4)]
        return f"DontCare -1 -1 -10 {' '.join(bbox)} -1 -1 -1 -1000 -1000 -1000 -10"
    return " ".join([
        draw(st.sampled_from(CLASSES[:-1])), draw(hundredths(0, 100)), str(draw(st.integers(0, 3))),
        draw(hundredths(-314, 314)), *(draw(hundredths(0, 120000)) for _ in range(4)),
        *(draw(hundredths(30, 2000)) for _ in range(3)), draw(hundredths(-5000, 5000)),
        draw(hundredths(-300, 500)), draw(hundredths(100, 8000)), draw(hundredths(-314, 314))])


@given(st.lists(label_lines(), max_size=6))
def test_labels_through_truth_and_markers_come_back_as_the_same_text(lines):
    truth = to_ground_truth([parse(line) for line in lines], LIDAR_TO_CAMERA)
    received = over_the_wire(truth)
    assert same(received, truth)
    expected = sorted(lines, key=lambda line: line.startswith("DontCare"))  # notes come last
    assert text_of(truth) == text_of(received) == expected


@given(label_lines().filter(lambda line: not line.startswith("DontCare")))
def test_a_label_can_be_computed_from_its_box(line):
    label = parse(line)
    truth = to_ground_truth([label], LIDAR_TO_CAMERA)
    again, = to_labels(GroundTruth.of(truth.boxes, truth.class_ids), LIDAR_TO_CAMERA)
    assert again["class"] == label["class"]
    np.testing.assert_allclose(again["dimensions"], label["dimensions"], atol=1e-9)
    np.testing.assert_allclose(again["location"], label["location"], atol=1e-9)
    assert abs(np.sin((again["rotation_y"] - label["rotation_y"]) / 2)) < 0.0025
    x, _, z = label["location"]  # alpha is the heading seen along the ray to the object
    assert abs(np.sin((again["alpha"] - (again["rotation_y"] - np.arctan2(x, z))) / 2)) < 1e-9
    assert -np.pi <= again["alpha"] <= np.pi


@given(label_lines().filter(lambda line: not line.startswith("DontCare")))
def test_boxes_have_the_corners_of_the_development_kit(line):
    """computeBox3D.m, with a camera that is level."""
    label = parse(line)
    level = np.eye(4)
    level[:3] = np.column_stack([AXES, [0.1, -0.2, -0.3]])
    h, w, length = label["dimensions"]
    cos, sin = np.cos(label["rotation_y"]), np.sin(label["rotation_y"])
    x = length / 2 * np.array([1, 1, -1, -1, 1, 1, -1, -1])
    y = h * np.array([0, 0, 0, 0, -1, -1, -1, -1])
    z = w / 2 * np.array([1, -1, -1, 1, 1, -1, -1, 1])
    camera = np.stack([cos * x + sin * z, y, cos * z - sin * x]).T + label["location"]
    lidar = (camera - level[:3, 3]) @ level[:3, :3]
    ours = box_corners(to_ground_truth([label], level).boxes)[0]
    distance = np.linalg.norm(ours[:, None] - lidar, axis=2)
    assert distance.min(axis=0).max() < 1e-9 and distance.min(axis=1).max() < 1e-9


@pytest.mark.parametrize("layout, count", [("object", 2), ("tracking", 5), ("raw", 3)])
def test_every_scan_is_read_as_it_is_in_the_file(tmp_path, layout, count):
    frames = open_kitti(LAYOUTS[layout](tmp_path))
    assert len(frames) == count
    for frame in frames:
        expected = scene(int(frame.points.stem))
        assert np.array_equal(frame.cloud(), expected)
        assert np.array_equal(frame.load().xyz, expected[:, :3])
        assert np.array_equal(frame.load().intensity, expected[:, 3])
        assert frame.load().stamp_ns == frame.stamp_ns
        assert frame.load().frame_id == "velodyne"


@each_layout
def test_the_calibration_is_the_product_of_its_matrices(tmp_path, layout):
    for frame in open_kitti(LAYOUTS[layout](tmp_path)):
        calibration = frame.calibration()
        np.testing.assert_allclose(calibration.lidar_to_camera, LIDAR_TO_CAMERA, atol=1e-12)
        assert np.array_equal(calibration.intrinsics, INTRINSICS)
        assert (calibration.width, calibration.height) == (1242, 375)


@each_layout
def test_frames_have_ascending_stamps_and_names_of_their_own(tmp_path, layout):
    frames = open_kitti(LAYOUTS[layout](tmp_path))
    stamps = [f.stamp_ns for f in frames]
    assert stamps == sorted({*stamps}) and len({f.name for f in frames}) == len(frames)


def test_object_and_tracking_frames_come_at_10_hz(tmp_path):
    assert [f.stamp_ns - START_NS for f in open_kitti(object_folder(tmp_path / "o", count=3))] == [
        0, 10**8, 2 * 10**8]
    frames = open_kitti(tracking_folder(tmp_path / "t"))
    first, second = ([f for f in frames if f.name.startswith(s)] for s in ("0000/", "0007/"))
    assert [f.stamp_ns - first[0].stamp_ns for f in first] == [0, 10**8, 2 * 10**8]
    assert [f.stamp_ns - second[0].stamp_ns for f in second] == [0, 10**8]
    assert second[0].stamp_ns - first[-1].stamp_ns > 10**9


def test_a_frame_that_is_missing_leaves_its_time_empty(tmp_path):
    root = tracking_folder(tmp_path)
    (root / "training/velodyne/0000/000001.bin").unlink()
    assert [f.stamp_ns - START_NS for f in open_kitti(root)[:2]] == [0, 2 * 10**8]


def test_raw_stamps_are_read_to_the_nanosecond(tmp_path):
    second = 1317042145 * 10**9  # date -u -d '2011-09-26 13:02:25' +%s
    assert [f.stamp_ns - second for f in open_kitti(raw_folder(tmp_path))] == [
        594360375, 700000000, 1000000001]


def test_object_labels_are_those_of_the_frame(tmp_path):
    root = object_folder(tmp_path)
    write(root / "training/label_2/000001.txt", "")
    first, second = open_kitti(root)
    assert text_of(first.truth()) == LABELS.splitlines()
    assert len(second.truth()) == 0 and second.truth().notes == ()


def test_tracking_labels_are_those_of_the_sequence_and_frame(tmp_path):
    first, second, third, *other = [f.truth() for f in open_kitti(tracking_folder(tmp_path))]
    assert first.labels == ["Pedestrian"] and first.extras[0]["track_id"] == 3
    assert [name for name, _ in first.notes] == ["DontCare"]
    assert len(second) == 0
    assert third.labels == ["Person_sitting"] and third.extras[0]["track_id"] == 4
    assert other == [None, None]  # this sequence has no label file
    assert all(same(over_the_wire(t), t) for t in (first, second, third))


def test_tracklets_are_boxes_on_their_bottom_face(tmp_path):
    first, second, third = [f.truth() for f in open_kitti(raw_folder(tmp_path))]
    assert len(first) == 0
    np.testing.assert_allclose(second.boxes, [[8, -1, -0.8, 0.9, 0.5, 1.8, 0.5]])
    assert second.extras[0] == {"track_id": 0, "occluded": 1, "truncated": 0.0}
    assert third.labels == ["Pedestrian", "Person_sitting"]
    np.testing.assert_allclose(third.boxes, [[9, -1, -0.8, 0.9, 0.5, 1.8, 0.6],
                                             [5, 2, -1.0, 0.8, 0.6, 1.2, -3]])
    assert [e["track_id"] for e in third.extras] == [0, 1]
    assert same(over_the_wire(third), third)


@each_layout
def test_folders_without_labels_have_none(tmp_path, layout):
    root = LAYOUTS[layout](tmp_path)
    for path in [*root.rglob("label_*/*.txt"), *root.rglob("tracklet_labels.xml")]:
        path.unlink()
    assert [f.truth() for f in open_kitti(root)] == [None] * len(open_kitti(root))


@pytest.mark.parametrize("inner", ["", "training", "2011_09_26",
                                   "2011_09_26/2011_09_26_drive_0001_sync"])
def test_a_folder_may_be_given_from_outside_or_inside(tmp_path, inner):
    folders = {layout: make(tmp_path / layout) for layout, make in LAYOUTS.items()}
    for root in folders.values():
        if (root / inner).is_dir():
            assert [f.points for f in open_kitti(root / inner)] == [
                f.points for f in open_kitti(root)]


def test_the_full_scan_wins_over_the_reduced_one(tmp_path):
    root = object_folder(tmp_path)
    for i in (1, 2):
        write(root / f"training/velodyne_reduced/{i:06}.bin", scene(i)[:50].tobytes())
    assert [len(f.cloud()) for f in open_kitti(root)] == [len(scene()), len(scene()), 50]


def test_a_scan_keeps_only_returns_that_can_be_used(tmp_path):
    root = object_folder(tmp_path)
    cloud = np.array([[1, 2, 3, 0.5], [0, 0, 0, 0.1], [np.nan, 1, 1, 0.2], [4, 5, 6, 0.7]], "f4")
    write(root / "training/velodyne/000000.bin", cloud.tobytes())
    frame = open_kitti(root)[0]
    assert frame.load().xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert frame.load().intensity.tolist() == [0.5, np.float32(0.7)]
    assert frame.cloud().tobytes() == cloud.tobytes()


def test_an_empty_scan_is_a_scan(tmp_path):
    assert read_velodyne(write(tmp_path / "empty.bin", b"")).shape == (0, 4)


def test_the_image_says_its_size(tmp_path):
    root = object_folder(tmp_path)
    write(root / "training/image_2/000001.png", png_header(640, 480))
    sizes = [(f.calibration().width, f.calibration().height) for f in open_kitti(root)]
    assert sizes == [(1242, 375), (640, 480)]


@pytest.mark.parametrize("content", [b"", b"\x89PNG", b"JFIF" * 10])
def test_what_is_no_png_says_nothing_about_the_size(tmp_path, content):
    path, image = write(tmp_path / "c.txt", calibration_text()), write(tmp_path / "i.png", content)
    calibration = read_calibration(path, image)
    assert (calibration.width, calibration.height) == (1242, 375)


@pytest.mark.parametrize("focal, size", [*IMAGE_SIZES.items(), (1000.0, (1242, 375))])
def test_the_focal_length_says_the_size_where_there_is_no_image(tmp_path, focal, size):
    text = calibration_text().replace("721.5377", str(focal))
    calibration = read_calibration(write(tmp_path / "c.txt", text))
    assert (calibration.width, calibration.height) == size


def test_the_pose_is_the_inverse_of_lidar_to_camera():
    camera, direct = CALIBRATION.camera(), INTRINSICS @ LIDAR_TO_CAMERA
    np.testing.assert_allclose(camera.projection, direct, atol=1e-9)
    assert (camera.width, camera.height) == (1242, 375)


PARTS = {  # broken file -> its new content (None: removed), and words of the message
    "velodyne/000000.bin": [(b"123", "multiple of 16")],
    "calib/000000.txt": [
        (None, "cannot read"), (b"\xff\xfe\x00", "cannot read"), ("", "no P2"),
        (calibration_text().replace("P2", "P3"), "no P2 of 12 numbers"),
        (calibration_text().replace("R0_rect", "x"), "no R0_rect of 9 numbers"),
        (calibration_text().replace("Tr_velo_to_cam", "x"), "no Tr_velo_to_cam of 12 numbers"),
        (calibration_text().replace("P2: ", "P2: 1 "), "no P2 of 12 numbers"),
        (calibration_text().replace("P2: 721.5377", "P2: wide"), "no P2 of 12 numbers"),
    ],
    "label_2/000000.txt": [
        (LABELS + "Car 0 0 0\n", ":4 is no KITTI label"),
        (LABELS.replace("1.52", "tall"), ":2 is no KITTI label"),
        ("\n" + LABELS.replace("Car", "Unicorn"), ":3 has the unknown class 'Unicorn'"),
        (b"\xff\xfe\x00", "cannot read"),
    ],
}


@pytest.mark.parametrize("file, content, words", [
    (file, content, words) for file, cases in PARTS.items() for content, words in cases])
def test_a_broken_file_is_named_and_the_other_frames_go_on(tmp_path, file, content, words):
    root = object_folder(tmp_path)
    path = root / "training" / file
    path.unlink()
    if content is not None:
        write(path, content)
    with pytest.raises(InputError) as error:
        kitti_scan(open_kitti(root)[0])
    assert str(path) in str(error.value) and words in str(error.value)
    assert "\n" not in str(error.value)
    broken, good = open_recording(kitti=root)
    assert isinstance(broken, InputError) and str(path) in str(broken)
    assert good.name == "000001"


@pytest.mark.parametrize("layout, file, content, words", [
    ("tracking", "training/calib/0000.txt", "", "no P2"),
    ("tracking", "training/label_02/0000.txt", "0 1 Car", ":1 is no KITTI label"),
    ("tracking", "training/label_02/0000.txt", "zero " + TRACKING_LABELS[2:],
     ":1 is no tracking label"),
    ("tracking", "training/label_02/0000.txt", "\n7\n", ":2 is no tracking label"),
    ("raw", "2011_09_26/calib_cam_to_cam.txt", "", "no S_rect_02"),
    ("raw", "2011_09_26/calib_velo_to_cam.txt", "", "no R of 9 numbers"),
    ("raw", "2011_09_26/2011_09_26_drive_0001_sync/tracklet_labels.xml", "<cut", "cannot read"),
    ("raw", "2011_09_26/2011_09_26_drive_0001_sync/tracklet_labels.xml", "<a/>", "cannot read"),
    ("raw", "2011_09_26/2011_09_26_drive_0001_sync/tracklet_labels.xml",
     TRACKLETS.replace(">Pedestrian<", ">Unicorn<"), "cannot read"),
])
def test_a_broken_file_of_a_sequence_is_named(tmp_path, layout, file, content, words):
    root = LAYOUTS[layout](tmp_path)
    write(root / file, content)
    with pytest.raises(InputError) as error:
        kitti_scan(open_kitti(root)[0])
    assert str(root / file) in str(error.value) and words in str(error.value)


@pytest.mark.parametrize("text", [None, "yesterday\n" * 3, "2011-09-26 13:02:25.5\n"])
def test_broken_time_stamps_are_named(tmp_path, text):
    path = next(raw_folder(tmp_path).rglob("timestamps.txt"))
    path.unlink()
    if text is not None:
        write(path, text)
    with pytest.raises(InputError, match=r"velodyne_points/timestamps\.txt"):
        open_kitti(tmp_path)


@pytest.mark.parametrize("layout, scan", [
    ("tracking", "training/velodyne/0000/notes.bin"),
    ("raw", "2011_09_26/2011_09_26_drive_0001_sync/velodyne_points/data/notes.bin")])
def test_a_scan_whose_name_is_no_number_is_named(tmp_path, layout, scan):
    root = LAYOUTS[layout](tmp_path)
    write(root / scan, b"")
    with pytest.raises(InputError, match=r"notes\.bin"):
        open_kitti(root)


@pytest.mark.parametrize("make", [lambda p: p, lambda p: p / "missing",
                                  lambda p: write(p / "file", b"")])
def test_what_is_no_kitti_folder_is_named(tmp_path, make):
    root = make(tmp_path)
    with pytest.raises(InputError, match="KITTI") as error:
        open_kitti(root)
    assert str(root) in str(error.value)


def test_real_object_labels_come_back_as_the_same_text(data):
    folder = data / "kitti_object/training"
    paths = sorted(folder.glob("label_2/*.txt"))
    assert paths
    for path in paths:
        to_camera = read_calibration(folder / "calib" / path.name).lidar_to_camera
        truth = over_the_wire(read_object_labels(path, to_camera))
        lines = [line for line in path.read_text().splitlines() if line]
        assert sorted(format_label(x) for x in to_labels(truth, to_camera)) == sorted(lines), path


def test_real_tracking_labels_come_back_as_the_same_numbers(data):
    folder = data / "kitti_tracking/training"
    to_camera = read_calibration(folder / "calib/0000.txt").lidar_to_camera
    path = folder / "label_02/0000.txt"
    back = [[frame, x["track_id"], x["class"], x["truncated"], x["occluded"], x["alpha"],
             *x["bbox"], *x["dimensions"], *x["location"], x["rotation_y"]]
            for frame, truth in read_tracking_labels(path, to_camera).items()
            for x in to_labels(over_the_wire(truth), to_camera)]
    lines = [line.split() for line in path.read_text().splitlines()]
    read = [[int(f), int(t), name, *map(float, rest)] for f, t, name, *rest in lines]
    assert sorted(back, key=str) == sorted(
        [[*row[:4], int(row[4]), *row[5:]] for row in read], key=str)


def test_real_labels_computed_from_their_boxes_are_the_same_to_two_decimals(data):
    folder = data / "kitti_object/training"
    for path in sorted(folder.glob("label_2/*.txt")):
        to_camera = read_calibration(folder / "calib" / path.name).lidar_to_camera
        truth = read_object_labels(path, to_camera)
        for box, extra in zip(truth.boxes, truth.extras):
            again, = to_labels(GroundTruth.of([box], [0]), to_camera)
            for name in ("dimensions", "location"):
                np.testing.assert_allclose(again[name], extra[name], atol=0.005)
            assert abs(np.sin((again["rotation_y"] - extra["rotation_y"]) / 2)) < 0.0025, path

"""Conversion of data sets to bags and back: frames, boxes, point labels and poses are kept."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from cli_samples import read_error_line, run_main
from format_samples import CALIBRATION, assert_equal_labels, make_format_drive, make_labels, make_sloped_pose
from marker_messages import make_detection_markers
from nuscenes_folder import make_tables, save
from robot_bags import (
    ON_BASE,
    compute_base_pose,
    list_stamps,
    make_mount_rows,
    make_odometry_rows,
    make_tf_rows,
    write_robot_bag,
)
from samples import DATA, needs_data

from lidar_perception.classes import CAR
from lidar_perception.data.bag import BagWriter
from lidar_perception.data.frame import Frame, PointTruth
from lidar_perception.data.open import open_recording
from lidar_perception.data.to_bag import write_bag
from lidar_perception.labels.datasets import write_dataset
from lidar_perception.labels.drive_labels import DriveLabels, read_frame_labels
from lidar_perception.labels.exchange import export_labels
from lidar_perception.labels.formats import bag as bag_format
from lidar_perception.robot.poses import invert_pose, transform_boxes
from lidar_perception.simulation.recording import simulate_frames
from lidar_perception.simulation.sensor import make_generic_sensor
from lidar_perception.testing.clouds import make_cloud_message
from lidar_perception.types import SENSOR_HEIGHT, Detections, GroundTruth, InputError, PointCloud
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.topics import ODOMETRY, POINTS
from lidar_studio import results
from msg_utils.detections import to_detection_array
from msg_utils.markers import to_marker_array
from msg_utils.stamps import make_header

MARKERS = "visualization_msgs/msg/MarkerArray"
SMALL = make_generic_sensor(32, -25.0, 5.0, 0.4, 10.0)
LAYOUTS = ("kitti", "kitti-tracking", "semantickitti")
REAL = {"kitti_object": "kitti", "kitti_tracking": "kitti-tracking", "semantickitti": "semantickitti"}


def assert_equal_frames(recording, others, boxes=1e-5, points=0.0):
    for frame, other in zip(recording, others, strict=True):
        scan, actual = frame.load(), other.load()
        np.testing.assert_allclose(actual.xyz, scan.xyz, atol=points)
        np.testing.assert_allclose(actual.intensity, scan.intensity, atol=1e-6 * (points > 0))
        assert actual.stamp_ns == scan.stamp_ns
        labels, actual = frame.point_truth(), other.point_truth()
        assert (labels is None) == (actual is None)
        if labels is not None:
            assert np.array_equal(actual.classes, labels.classes)
            assert np.array_equal(actual.instances, labels.instances)
        pose_before, actual = frame.pose(), other.pose()
        if pose_before is not None and actual is not None:
            np.testing.assert_allclose(actual, pose_before, atol=1e-6)
        truth, actual = frame.truth(), other.truth()
        assert (truth is None) == (actual is None)
        if truth is not None:
            np.testing.assert_allclose(actual.boxes, truth.boxes, atol=boxes)
            assert actual.labels == truth.labels and actual.notes == truth.notes


@pytest.mark.parametrize("layout", LAYOUTS)
def test_simulated_data_set_survives_conversion(layout, simulated_data_sets, tmp_path):
    recording = open_recording(simulated_data_sets / layout)
    write_bag(tmp_path / "bag", recording)
    bag = open_recording(tmp_path / "bag")
    summary = write_dataset(layout, bag, tmp_path / "back")
    assert summary.frames == len(recording)
    back = open_recording(tmp_path / "back")
    assert (back.layout, back.contents) == (recording.layout, recording.contents)
    assert_equal_frames(recording, back)
    if layout != "semantickitti":  # label files are identical
        for file in (simulated_data_sets / layout).glob("training/label_*/*.txt"):
            other = tmp_path / "back" / file.relative_to(simulated_data_sets / layout)
            assert other.read_text().split() == file.read_text().split()


@needs_data
@pytest.mark.parametrize("folder", REAL)
def test_real_data_set_survives_conversion(folder, tmp_path):
    recording = open_recording(DATA / folder)
    recording = recording.select([frame.name for frame in recording.frames[:4]])
    write_bag(tmp_path / "bag", recording)
    write_dataset(REAL[folder], open_recording(tmp_path / "bag"), tmp_path / "back")
    assert_equal_frames(recording, open_recording(tmp_path / "back"))


@pytest.fixture(scope="module")
def simulated_bag(streets, tmp_path_factory):
    """Return the bag of a simulated drive."""
    path = tmp_path_factory.mktemp("bags") / "drive"
    write_bag(path, simulate_frames(5, 4, SMALL))
    return path


def test_simulated_drive_survives_conversion_to_nuscenes(simulated_bag, tmp_path):
    summary = write_dataset("nuscenes", open_recording(simulated_bag), tmp_path / "n")
    assert all(remark.startswith("written as another class: ") for remark in summary.remarks)
    recording, back = list(open_recording(simulated_bag)), list(open_recording(tmp_path / "n"))
    assert sum(len(frame.truth()) for frame in recording) == summary.boxes > 0
    tracks = {}
    for frame, other in zip(recording, back, strict=True):
        scan, other_scan = frame.load(), other.load()
        away = (np.abs(scan.xyz[:, :2]) >= 1.0).any(axis=1)  # nearer points are on the vehicle
        np.testing.assert_allclose(other_scan.xyz, scan.xyz[away], atol=1e-5)
        np.testing.assert_allclose(other_scan.intensity, scan.intensity[away], atol=1e-6)
        np.testing.assert_allclose(other.pose(), frame.pose(), atol=1e-6)
        assert other.sensor_height == frame.sensor_height
        truth, labels = frame.truth(), read_frame_labels(other)
        np.testing.assert_allclose(labels.boxes, truth.boxes, atol=1e-6)
        for name, found, extra, track in zip(truth.labels, labels.class_names, truth.extras, labels.track_ids.tolist()):
            assert found == {"Van": "Car", "Person_sitting": "Pedestrian"}.get(name, name)
            assert tracks.setdefault(extra["track_id"], track) == track
    assert len(set(tracks.values())) == len(tracks)


def make_frames_at(seconds, **more):
    return [
        Frame.of(
            str(i),
            PointCloud.of(np.full((3, 3), 5.0 + i), None, 1_700_000_000_000_000_000 + round(s * 1e9), "top"),
            **more,
        )
        for i, s in enumerate(seconds)
    ]


@pytest.mark.parametrize("kind", ["tables", "results"])
def test_labels_of_a_tilted_vehicle_survive_conversion(kind, tmp_path):
    """nuScenes boxes are upright in the global frame, those of the package in the vehicle frame."""
    tables = make_tables(frames=2, objects=8, scenes=("scene-0001",))
    recording = open_recording(save(tmp_path / "there", tables))
    if kind == "tables":
        write_dataset("nuscenes", recording, tmp_path / "back")
        written = json.loads(next(tmp_path.glob("back/*/sample_annotation.json")).read_text())
    else:
        labels = DriveLabels(list(map(read_frame_labels, recording)))
        export_labels(labels, "nuscenes-detection", tmp_path / "r.json", recording.frames)
        results = json.loads((tmp_path / "r.json").read_text())["results"]
        written = [row for rows in results.values() for row in rows]
    counts = ("num_lidar_pts", "num_radar_pts")
    rows = {tuple(np.round(row["translation"], 3)): row for row in tables["sample_annotation"]}
    assert len(written) == len(rows) > 8
    for row in written:
        old = rows[tuple(np.round(row["translation"], 3))]
        np.testing.assert_allclose(row["rotation"], old["rotation"], atol=1e-9)
        np.testing.assert_allclose(row["size"], old["size"], atol=1e-6)
        assert kind == "results" or [row[key] for key in counts] == [old[key] for key in counts]


def test_camera_is_assumed_and_frame_numbers_follow_time(tmp_path):
    """A missing scan leaves a gap in the numbers; after a longer gap a new drive starts."""
    frames = make_frames_at([0, 0.1, 0.31, 0.4, 30, 30.07, 30.13], pose=np.eye(4).copy)
    labels = make_labels(frames, "kitti-tracking")
    summary = write_dataset("kitti-tracking", frames, tmp_path / "k", labels)
    assert (summary.frames, summary.drives) == (7, 2)
    assert {remark.split(":")[0]: n for remark, n in summary.remarks.items()} == {
        "assumed": 7,
        "left out": 7,
        "boxes without a track id": 6,
    }
    back = open_recording(tmp_path / "k")
    assert [frame.name for frame in back] == [
        *(f"0000/{i:06}" for i in (0, 1, 3, 4)),
        *(f"0001/{i:06}" for i in range(3)),
    ]
    found = DriveLabels(
        [replace(read_frame_labels(frame), name=a.name, stamp_ns=a.stamp_ns) for a, frame in zip(frames, back)]
    )
    assert_equal_labels(labels, found, 2e-6)


@pytest.mark.parametrize("layout", REAL)
@pytest.mark.parametrize("height", [0.62, SENSOR_HEIGHT, 2.9])
def test_sensor_height_is_kept(tmp_path, layout, height):
    points = PointTruth(np.zeros(3, np.uint16), np.zeros(3, np.uint16))
    frames = make_frames_at([0, 0.1], point_truth=lambda: points, sensor_height=height)
    write_dataset(layout, frames, tmp_path / "folder")
    assert [f.sensor_height for f in open_recording(tmp_path / "folder")] == [height] * 2
    assert (tmp_path / "folder/mount.json").exists() == (height != SENSOR_HEIGHT)
    assert open_recording(tmp_path / "folder", sensor_height=1.0).frames[0].sensor_height == 1.0


def test_point_labels_are_written_if_the_layout_has_them(tmp_path, monkeypatch, capsys):
    points = PointTruth(np.array([40, 252, 0], np.uint16), np.array([0, 7, 65535], np.uint16))
    write_bag(tmp_path / "labelled", make_frames_at([0, 0.1], point_truth=lambda: points, calibration=CALIBRATION))
    write_bag(tmp_path / "bare", make_frames_at([0, 0.1]))
    assert (
        run_main(monkeypatch, "convert", tmp_path / "labelled", "--to", "semantickitti", "--out", tmp_path / "s") == 0
    )
    for frame in open_recording(tmp_path / "s"):
        assert frame.point_truth().instances.tolist() == [0, 7, 65535]
    assert run_main(monkeypatch, "convert", tmp_path / "labelled", "--to", "kitti", "--out", tmp_path / "k") == 0
    assert "left out: point labels" in capsys.readouterr().out
    assert run_main(monkeypatch, "convert", tmp_path / "bare", "--to", "semantickitti", "--out", tmp_path / "none") == 2
    assert "has no point labels" in read_error_line(capsys)
    assert not (tmp_path / "none").exists() and not list(tmp_path.glob(".*"))


def test_detections_on_a_topic_become_labels(tmp_path, monkeypatch):
    """The topic has a MarkerArray of the package's nodes or a Detection3DArray of any node, also of tracks."""
    frames, rng = make_format_drive("one"), np.random.default_rng(2)
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/found", "visualization_msgs/msg/MarkerArray")
        bag.add_topic("/tracks", "vision_msgs/msg/Detection3DArray")
        expected = []
        for i, frame in enumerate(frames):
            found = Detections.of(rng.uniform(1, 9, (i, 7)) / [1, 1, 1, 1, 1, 1, 3], 0, 0.5)
            header = make_header(frame.stamp_ns, "velodyne", make_bag_message)
            bag.write("/found", frame.stamp_ns, make_detection_markers(found, header, make_bag_message))
            bag.write(
                "/tracks",
                frame.stamp_ns,
                to_detection_array(
                    found.boxes,
                    ["tree"] * i,
                    found.scores.tolist(),
                    header=header,
                    make=make_bag_message,
                    ids=[100 + k for k in range(i)],
                ),
            )
            expected.append(found.boxes.astype(float))
    found = bag_format.read(tmp_path / "bag", frames, "/found")
    tracks = bag_format.read(tmp_path / "bag", frames, "/tracks")
    for boxes, one, other in zip(expected, found.frames, tracks.frames):
        for each in (one, other):
            np.testing.assert_allclose(each.boxes, boxes, atol=1e-9)
            assert each.scores.tolist() == [0.5] * len(boxes)
        assert one.track_ids.tolist() == [-1] * len(boxes)
        assert other.track_ids.tolist() == [100 + k for k in range(len(boxes))]
        assert other.class_names == ["tree"] * len(boxes)


@pytest.mark.parametrize(
    "parts", [[make_odometry_rows(ODOMETRY), make_mount_rows()], [make_tf_rows(), make_mount_rows()], []]
)
def test_boxes_are_transformed_to_the_frame_of_the_clouds(parts, tmp_path):
    """Nodes with target_frame:=odom publish such boxes. Unconnected frames are reported."""
    boxes = np.array([[10.0, 2, 0.5, 4, 2, 1.5, 0.3]])
    rows = []
    for stamp in list_stamps():
        marked = to_marker_array(
            boxes, ["Car"], ids=[1], make=make_bag_message, header=make_header(stamp, "odom", make_bag_message)
        )
        rows += [(topic, MARKERS, stamp, marked) for topic in ("/n/output/detections", "/n/output/tracks")]
    recording = write_robot_bag(tmp_path / "bag", *map(list, parts), rows)
    frames, poses = recording.frames[:], recording.frames.poses
    if not parts:
        with pytest.raises(InputError, match="from 'odom' to the frame of the clouds 'lidar'"):
            bag_format.read(tmp_path / "bag", frames, "/n/output/detections")
        assert not results.read_recorded_results(poses, list_stamps()).sources
        return
    labels = bag_format.read(tmp_path / "bag", frames, "/n/output/detections")
    recorded_results = results.read_recorded_results(poses, list_stamps())
    for i, (frame, each) in enumerate(zip(frames, labels.frames)):
        near = transform_boxes(boxes, invert_pose(compute_base_pose(frame.stamp_ns) @ ON_BASE))
        np.testing.assert_allclose(each.boxes, near, atol=1e-3)
        np.testing.assert_allclose(recorded_results.sources["n"].detect(i, frame).boxes, near, atol=1e-3)
        np.testing.assert_allclose(recorded_results.tracks[0]["boxes"][i][1:8], near[0], atol=1e-3)


def test_scans_with_equal_stamps_are_kept(tmp_path):
    twice = make_frames_at([0.0, 0.1, 0.1])
    write_dataset("nuscenes", twice, tmp_path / "nuscenes")
    assert len({f.points for f in open_recording(tmp_path / "nuscenes")}) == 3
    skipped = []
    assert write_bag(tmp_path / "plain", twice) == 3
    truth = GroundTruth.of(np.ones((1, 7)), [CAR])
    assert write_bag(tmp_path / "bag", [replace(f, truth=lambda: truth) for f in twice], skipped=skipped) == 2
    assert "another labelled scan has the same stamp" in skipped[0]
    unset = [replace(f, stamp_ns=0) for f in make_frames_at([0, 1])]
    with BagWriter(tmp_path / "unset") as bag:  # some drivers set no stamp
        bag.add_topic(POINTS, "sensor_msgs/msg/PointCloud2")
        for i, frame in enumerate(unset, 5):
            bag.write(POINTS, i * 10**9, make_cloud_message(frame.load().xyz, 0, "top"))
    assert [f.stamp_ns for f in open_recording(tmp_path / "unset")] == [5 * 10**9, 6 * 10**9]


def test_detections_of_a_bag_become_a_data_set(simulated_bag, tmp_path, monkeypatch, capsys):
    recording = list(open_recording(simulated_bag))
    labels = DriveLabels(list(map(read_frame_labels, recording)))
    export = tmp_path / "labels"
    bag_format.write(labels, export, recording)
    for topic in ("/ground_truth/detections", "/ground_truth/detections_3d"):
        out = tmp_path / topic.replace("/", "_")
        assert (
            run_main(monkeypatch, "convert", export, "--to", "kitti-tracking", "--detections", topic, "--out", out) == 0
        )
        back = open_recording(out)
        found = DriveLabels(
            [replace(read_frame_labels(f), name=a.name, stamp_ns=a.stamp_ns) for a, f in zip(recording, back)]
        )
        expected = labels
        if topic.endswith("3d"):  # each box has a score
            expected = DriveLabels([replace(f, scores=np.ones(len(f))) for f in labels.frames])
        assert_equal_labels(expected, found, 2e-6)
    assert (
        run_main(monkeypatch, "convert", export, "--detections", "/odom", "--out", tmp_path / "no", "--to", "nuscenes")
        == 2
    )
    capsys.readouterr()


def test_poses_are_relative_to_the_first_scan(tmp_path):
    frames = [
        replace(f, point_truth=lambda: PointTruth(np.zeros(50, np.uint16), np.zeros(50, np.uint16)))
        for f in make_format_drive("one", frames=3)
    ]
    write_bag(tmp_path / "bag", frames)
    write_dataset("semantickitti", open_recording(tmp_path / "bag"), tmp_path / "s")
    first = np.linalg.inv(make_sloped_pose(5))
    for i, frame in enumerate(open_recording(tmp_path / "s")):
        np.testing.assert_allclose(frame.pose(), first @ make_sloped_pose(5 + i), atol=1e-6)

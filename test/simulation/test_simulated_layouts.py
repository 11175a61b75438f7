"""Simulated data sets: properties of scans, and reading of every layout."""

import numpy as np
import pytest
from simulate_samples import TINY, run_simulate

from lidar_perception.data.kitti import write as write_kitti
from lidar_perception.data.kitti.labels import read_object_labels, read_tracking_labels
from lidar_perception.data.open import open_recording
from lidar_perception.data.semantickitti import MOVING, THINGS
from lidar_perception.geometry import box_corners, points_in_box, wrap_angle
from lidar_perception.simulation.camera import FORWARD_CAMERA, make_kitti_labels
from lidar_perception.simulation.drive import simulate_drive, simulate_scan
from lidar_perception.simulation.scene import CROWDED_ZONES
from lidar_perception.simulation.sensor import SENSORS
from lidar_perception.types import SENSOR_HEIGHT

pytestmark = [
    pytest.mark.no_cover,  # covered by other tests
    pytest.mark.usefixtures("streets", "tiny_sensor"),
]


def test_single_scan_equals_scan_of_drive():
    several = list(simulate_drive(3, 3, TINY))
    for i, scan in enumerate(several):
        single = simulate_scan(3, i, TINY)
        assert scan.frame.xyz.tobytes() == single.frame.xyz.tobytes()
        assert np.array_equal(scan.semantic, single.semantic)
        assert scan.truth.extras == single.truth.extras
    assert np.array_equal(several[0].pose, np.eye(4)) and several[2].pose[0, 3] > 0


def test_columns_of_scan_agree_with_points():
    scan = simulate_scan(3, 7, TINY)
    xyz, n = scan.frame.xyz.astype(float), len(scan.frame)
    assert {scan.semantic.dtype, scan.instance.dtype, scan.ring.dtype} == {np.dtype(np.uint16)}
    assert all(len(c) == n for c in (scan.semantic, scan.instance, scan.ring, scan.time))
    elevation = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
    error = np.abs(elevation - np.array(TINY.elevations)[scan.ring])
    assert np.median(error) < 0.01  # beams have different origins, and the sensor moves
    assert scan.time.dtype == np.float32 and np.ptp(scan.time) < 1 / TINY.rate
    ahead = (np.abs(xyz[:, 1]) < 0.1) & (xyz[:, 0] > 0)
    assert np.abs(scan.time[ahead]).max() < 0.01  # at the stamp, the sensor points forward
    assert scan.instance[np.isin(scan.semantic, (40, 48, 50, 70, 72, 80))].max() == 0
    things = scan.instance > 0
    assert np.isin(scan.semantic[things], [*THINGS, *MOVING, 99]).all()  # 99: carried objects
    assert np.isin(scan.semantic, list(MOVING)).any() and (scan.semantic == 10).any()
    for box, extra in zip(scan.truth.boxes, scan.truth.extras):
        on_object = scan.instance == extra["track_id"]
        assert on_object.sum() == extra["num_points"]
        assert points_in_box(xyz[on_object], box, margin=1.0).all()  # moving parts, mirrors, umbrellas


def test_object_layout_is_read_as_written(simulated_data_sets):
    recording = open_recording(simulated_data_sets / "kitti")
    assert len(recording) == 5
    for number, frame_read in enumerate(recording):
        scan = simulate_scan(3 + number // 2, number % 2, TINY)
        order = np.argsort(scan.ring, kind="stable")
        assert frame_read.name == f"{number:06}"
        frame, camera = frame_read.load(), frame_read.camera()
        assert np.array_equal(frame.xyz, scan.frame.xyz[order])
        assert np.array_equal(frame.intensity, scan.frame.intensity[order])
        assert np.allclose(camera.projection, FORWARD_CAMERA.camera().projection)
        assert (camera.width, camera.height) == (1242, 375)
        assert_same_objects(frame_read.truth(), make_kitti_labels(scan.truth), 0.0051)


def test_hidden_objects_become_dont_care():
    scan = simulate_scan(33, 0, SENSORS["hdl64e"], CROWDED_ZONES)
    visible = write_kitti.keep_visible_objects(scan.truth, FORWARD_CAMERA)
    labels = make_kitti_labels(scan.truth)
    assert 0 < len(labels) < len(visible) == len(labels) + len(labels.notes)
    assert all(e["num_points"] >= 5 and e["visible"] >= 0.15 for e in labels.extras)
    labelled = {e["track_id"] for e in labels.extras}
    left_out = [e for e in visible.extras if e["track_id"] not in labelled]
    assert all(e["num_points"] < 5 or e["visible"] < 0.15 for e in left_out)
    assert [e["bbox"] for e in left_out] == [note["bbox"] for _, note in labels.notes]


def test_tracking_layout_is_read_as_written(simulated_data_sets):
    frames = open_recording(simulated_data_sets / "kitti-tracking").frames
    assert [f.name for f in frames] == ["0000/000000", "0000/000001", "0001/000000", "0001/000001", "0002/000000"]
    for number, frame_read in enumerate(open_recording(simulated_data_sets / "kitti-tracking")):
        scan = simulate_scan(3 + number // 2, number % 2, TINY)
        expected = make_kitti_labels(scan.truth)
        truth = frame_read.truth()
        assert_same_objects(truth, expected, 6e-7, truncation=0.26)
        assert [e["track_id"] for e in truth.extras] == [e["track_id"] for e in expected.extras]


def assert_same_objects(actual, expected, accuracy, truncation=None):
    """Assert that labels agree within the accuracy of the text format."""
    assert actual.labels == expected.labels
    assert [name for name, _ in actual.notes] == [name for name, _ in expected.notes]
    for (_, a), (_, b) in zip(actual.notes, expected.notes):
        assert a["bbox"] == pytest.approx(b["bbox"], abs=accuracy)
    assert np.abs(actual.boxes - expected.boxes)[:, :6].max(initial=0) <= 1.6 * accuracy
    yaw_difference = wrap_angle(actual.boxes[:, 6] - expected.boxes[:, 6])
    assert np.abs(yaw_difference).max(initial=0) <= accuracy
    for a, b in zip(actual.extras, expected.extras):
        scale = 2 if truncation else 1  # the tracking layout has levels 0, 1 and 2
        assert abs(a["truncated"] / scale - b["truncated"]) <= (truncation or accuracy)
        assert a["occluded"] == b["occluded"]
        assert np.allclose(a["bbox"], b["bbox"], atol=accuracy)


def test_semantickitti_layout_is_read_as_written(simulated_data_sets):
    root = simulated_data_sets / "semantickitti"
    frames = open_recording(root).frames
    assert [f.name for f in frames] == ["00/000000", "00/000001", "01/000000", "01/000001", "02/000000"]
    for number, frame in enumerate(frames):
        scan = simulate_scan(3 + number // 2, number % 2, TINY)
        order = np.argsort(scan.ring, kind="stable")
        truth = frame.point_truth()
        assert np.array_equal(frame.load().xyz, scan.frame.xyz[order])
        assert np.array_equal(truth.classes, scan.semantic[order])
        assert np.array_equal(truth.instances, scan.instance[order])
        assert np.allclose(frame.pose(), scan.pose, atol=1e-9)  # inverse of format_pose
    for sequence in range(2):
        folder = root / f"sequences/{sequence:02}"
        calibration = dict(line.split(": ") for line in (folder / "calib.txt").read_text().splitlines())
        to_camera = np.vstack([np.fromstring(calibration["Tr"], sep=" ").reshape(3, 4), [0, 0, 0, 1]])
        poses = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
        assert np.loadtxt(folder / "times.txt").tolist() == [0.0, 0.1]
        for moment, pose in enumerate(poses):  # as SemanticKITTI's tools do
            pose = np.linalg.inv(to_camera) @ np.vstack([pose, [0, 0, 0, 1]]) @ to_camera
            assert np.allclose(pose, simulate_scan(3 + sequence, moment, TINY).pose, atol=1e-9)


@pytest.mark.parametrize(
    "layout, inner",
    [("kitti", "training/velodyne"), ("kitti-tracking", "training/velodyne/0000"), ("semantickitti", "sequences/00")],
)
def test_sensor_height_is_kept_in_every_layout(tmp_path, layout, inner):
    low = tmp_path / "low"
    assert run_simulate(low, layout, 2, 1, "--mount-height", 0.6).exit_code == 0
    for path in (low, low / inner):
        recording = open_recording(path)
        assert recording.has_sensor_height and {frame.sensor_height for frame in recording} == {0.6}
    assert open_recording(low, sensor_height=1.0).frames[0].sensor_height == 1.0
    for other in (
        "{",
        "[" * 10**4,
        '{"height": 480}',  # written by another program
        '{"height": "1", "sensor_digest": ""}',
        '{"height": NaN, "sensor_digest": ""}',
    ):
        (low / "dataset.json").write_text(other)
        assert open_recording(low).frames[0].sensor_height == SENSOR_HEIGHT


def test_bag_contains_consecutive_streets(tmp_path):
    result = run_simulate(tmp_path / "bag", "mcap", 4, 1, "--streets-of", 2)
    assert result.exit_code == 0, result.output
    recording = list(open_recording(tmp_path / "bag"))
    for number, frame_read in enumerate(recording):
        scan = simulate_scan(3 + number // 2, number % 2, TINY)
        assert np.array_equal(frame_read.load().xyz, scan.frame.xyz)
    stamps = [r.load().stamp_ns for r in recording]
    assert np.diff(stamps).tolist() == [10**8, 101 * 10**8, 10**8]


def test_image_boxes_contain_projected_corners():
    rng = np.random.default_rng(0)
    boxes = np.column_stack(
        [
            rng.uniform(-10, 60, 300),
            rng.uniform(-20, 20, 300),
            rng.uniform(-2, 1, 300),
            rng.uniform(0.3, 6, (300, 3)),
            rng.uniform(-4, 4, 300),
        ]
    )
    rectangles, outside = write_kitti.project_boxes(boxes, FORWARD_CAMERA)
    in_image = np.isfinite(rectangles[:, 0])
    assert 30 < in_image.sum() < 250 and ((outside >= 0) & (outside <= 1)).all()
    assert (rectangles[in_image] >= 0).all() and (rectangles[in_image] <= [1241, 374, 1241, 374]).all()
    projection = FORWARD_CAMERA.camera().projection
    corners = box_corners(boxes) @ projection[:, :3].T + projection[:, 3]
    in_front = (corners[..., 2] > write_kitti.MIN_DEPTH_M).all(axis=1)
    pixels = corners[..., :2] / corners[..., 2:]
    inside = in_front & ((pixels >= 0) & (pixels <= [1241, 374])).all(axis=(1, 2)) & in_image
    assert inside.sum() > 10 and np.abs(outside[inside]).max() < 1e-9
    assert np.allclose(
        rectangles[inside], np.concatenate([pixels[inside].min(axis=1), pixels[inside].max(axis=1)], axis=1)
    )
    # A box that reaches behind the camera: all of its points in the image are in its 2D box.
    for box, limits in zip(boxes[~in_front & in_image], rectangles[~in_front & in_image]):
        inner = rng.uniform(-0.5, 0.5, (4000, 3)) * box[3:6]
        cos, sin = np.cos(box[6]), np.sin(box[6])
        points = inner @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) + box[:3]
        p = points @ projection[:, :3].T + projection[:, 3]
        p = p[p[:, 2] > write_kitti.MIN_DEPTH_M]
        uv = np.clip(p[:, :2] / p[:, 2:], 0, [1241, 374])
        assert (uv >= limits[:2] - 1e-6).all() and (uv <= limits[2:] + 1e-6).all()


def test_image_boxes_agree_with_real_labels(data):
    worst, errors = [], []
    for frame in open_recording(data / "kitti_object"):
        truth = frame.truth()
        boxes, outside = write_kitti.project_boxes(truth.boxes, frame.calibration())
        for box, truncated, extra in zip(boxes, outside, truth.extras):
            worst.append(np.abs(box - extra["bbox"]).max())
            errors.append(abs(truncated - extra["truncated"]))
    assert np.median(worst) < 0.5 and np.max(errors) < 0.07


def test_labels_without_objects_are_read_as_written(tmp_path):
    empty = simulate_scan(3, 0, TINY).truth
    empty = type(empty).of([], [])
    write_kitti.write_object(tmp_path, 0, np.zeros((0, 4)), empty, FORWARD_CAMERA)
    assert len(read_object_labels(tmp_path / "training/label_2/000000.txt", np.eye(4))) == 0
    text = write_kitti.format_tracking_labels(0, empty, FORWARD_CAMERA)
    (tmp_path / "0000.txt").write_text(text)
    assert read_tracking_labels(tmp_path / "0000.txt", np.eye(4)) == {}

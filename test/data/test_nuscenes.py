"""nuScenes folders: frames, labels, velocities, and errors in tables and sweeps."""

from __future__ import annotations

import copy
import json

import numpy as np
import nuscenes_folder as folder
import nuscenes_reference as reference
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lidar_perception.data.nuscenes import labels as nuscenes_labels
from lidar_perception.data.nuscenes import tables as nuscenes_tables
from lidar_perception.data.nuscenes.boxes import (
    ATTRIBUTES,
    CATEGORIES,
    NAMES,
    GlobalBoxes,
    to_global_boxes,
    to_local_boxes,
)
from lidar_perception.data.nuscenes.folder import EGO_RADIUS_M, SWEEP_COLUMNS, open_nuscenes
from lidar_perception.data.nuscenes.tables import Tables
from lidar_perception.data.records import read_records
from lidar_perception.geometry import box_corners, points_in_box, wrap_angle
from lidar_perception.types import InputError

TABLES = folder.make_tables(seed=3, frames=4, objects=30)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return folder.save(tmp_path_factory.mktemp("nuscenes"), TABLES)


@pytest.fixture
def write_changed_tables(tmp_path):
    """Return a function that writes the tables after a change, without sweeps."""

    def write(change=lambda tables: None, version=folder.VERSION):
        tables = copy.deepcopy(TABLES)
        change(tables)
        return folder.save(tmp_path / "changed", tables, version, sweeps=False)

    return write


def find_labels(frame):
    return [row for row in TABLES["sample_annotation"] if row["sample_token"] == frame.native.token]


def are_equal_frames(a, b):
    return [f.native.token for f in a] == [f.native.token for f in b] and all(
        f.name == g.name
        and f.points.name == g.points.name
        and f.stamp_ns == g.stamp_ns
        and np.array_equal(f.pose(), g.pose())
        and np.array_equal(f.truth().boxes, g.truth().boxes)
        for f, g in zip(a, b)
    )


def test_key_frames_are_ordered_by_scene_and_time(root):
    frames = open_nuscenes(root)
    assert [f.name for f in frames] == [f"{s}/{i:02}" for s in folder.SCENES for i in range(4)]
    assert [f.native.token for f in frames] == [f"s{s}k{i}" for s in range(2) for i in range(4)]
    assert all(f.points.parent == root / "samples/LIDAR_TOP" and f.points.exists() for f in frames)
    assert frames[0].stamp_ns == next(r["timestamp"] for r in TABLES["sample_data"]) * 1000
    assert {f.sensor_height for f in frames} == {folder.SENSOR[2]}


def test_points_of_an_object_are_inside_its_box(root):
    boxes = 0
    for frame in open_nuscenes(root):
        scan, truth, rows = frame.load(), frame.truth(), find_labels(frame)
        assert len(truth) == len(rows)
        for i, (box, extras) in enumerate(zip(truth.boxes, truth.extras)):
            assert extras["lidar_points"] == rows[i]["num_lidar_pts"]
            if np.abs(box[:2]).max() > 10 and extras["lidar_points"]:
                inside = points_in_box(scan.xyz, box)
                assert inside.sum() >= folder.POINTS_IN_BOX
                boxes += 1
    assert boxes > 100


def test_sensor_axes_are_rotated_to_those_of_the_vehicle(write_changed_tables):
    def rotate_sensor(tables):
        for row in tables["calibrated_sensor"]:
            row["rotation"] = [np.sqrt(0.5), 0, 0, -np.sqrt(0.5)]

    frame = open_nuscenes(write_changed_tables(rotate_sensor))[0]
    frame.points.parent.mkdir(parents=True)
    np.array(
        [
            [0, 10, -1, 51, 4],
            [3, 5, 0, 255, 31],
            [0.5, 0.5, 0, 9, 1],
            [0, 0, 0, 0, 0],
            [np.nan, 1, 1, 1, 1],
            [0, -1.5, 0, 0, 7],
        ],
        np.float32,
    ).tofile(frame.points)
    scan = frame.load()
    np.testing.assert_allclose(scan.xyz, [[10, 0, -1], [5, -3, 0], [-1.5, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(scan.intensity, [0.2, 1, 0], atol=1e-7)
    assert scan.xyz.dtype == scan.intensity.dtype == np.float32
    assert read_records(frame.points, SWEEP_COLUMNS).shape == (6, 5) and scan.stamp_ns == frame.stamp_ns


def test_ego_vehicle_returns_are_dropped(root):
    frame = open_nuscenes(root)[0]
    cloud, scan = read_records(frame.points, SWEEP_COLUMNS), frame.load()
    own = (np.abs(cloud[:, :2]) < EGO_RADIUS_M).all(axis=1)
    assert own.sum() >= 50 and len(scan) == len(cloud) - own.sum()


def test_pose_transforms_frame_boxes_to_global_labels(root):
    for frame in open_nuscenes(root):
        rows, truth = find_labels(frame), frame.truth()
        centres, sizes, rotations = to_global_boxes(truth.boxes, frame.pose())
        np.testing.assert_allclose(centres, [r["translation"] for r in rows], atol=1e-9)
        np.testing.assert_allclose(sizes[:, [1, 0, 2]], [r["size"] for r in rows])
        for row, rotation in zip(rows, rotations):
            assert abs(np.dot(row["rotation"], rotation)) > 1 - 1e-3  # the vehicle is tilted
            assert abs(wrap_angle(reference.yaw(row["rotation"]) - reference.yaw(rotation))) < 1e-3
        assert np.linalg.norm(frame.pose()[:3, 3] - frame.native.ego) == pytest.approx(np.linalg.norm(folder.SENSOR))


angles = st.floats(-3.1, 3.1)


@given(st.integers(0, 2**32 - 1), angles, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_global_transform_is_invertible(seed, yaw, pitch, roll):
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("zyx", [yaw, pitch, roll]).as_matrix()
    pose[:3, 3] = rng.uniform(-2000, 2000, 3)
    boxes = np.column_stack([rng.uniform(-50, 50, (5, 3)), rng.uniform(0.3, 9, (5, 3)), rng.uniform(-3.1, 3.1, 5)])
    global_boxes = GlobalBoxes.of(*to_global_boxes(boxes, pose), 0)
    np.testing.assert_allclose(to_local_boxes(global_boxes, pose), boxes, atol=1e-8)
    # The box moves rigidly: its corners are transformed like points.
    corners = box_corners(boxes)
    for box, centre, rotation, own in zip(boxes, global_boxes.centres, global_boxes.rotations, corners):
        signs = np.array([[x, y, z] for z in (-1, 1) for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))]) / 2
        expected = Rotation.from_quat(np.roll(rotation, -1)).apply(signs * box[3:6]) + centre
        np.testing.assert_allclose(own @ pose[:3, :3].T + pose[:3, 3], expected, atol=1e-8)


def test_empty_boxes_are_transformed():
    empty = GlobalBoxes.none()
    assert len(empty) == 0 and to_local_boxes(empty, np.eye(4)).shape == (0, 7)
    assert [a.shape for a in to_global_boxes(np.zeros((0, 7)), np.eye(4))] == [(0, 3), (0, 3), (0, 4)]
    assert len(GlobalBoxes.concatenate([])) == 0


def test_velocities_match_the_reference(root):
    times = {r["token"]: r["timestamp"] for r in TABLES["sample"]}
    rows = {r["token"]: r for r in TABLES["sample_annotation"]}
    known = unknown = 0
    for frame in open_nuscenes(root):
        for row, found in zip(find_labels(frame), frame.native.labels().boxes.velocities):
            expected = reference.velocity(row, rows, times)
            if expected is None:
                assert np.isnan(found).all()
                unknown += 1
            else:
                np.testing.assert_allclose(found, expected, atol=1e-5)
                known += 1
    assert known > 50 and unknown > 10


def test_labels_have_names_and_attributes(root):
    tracks = {}
    for frame in open_nuscenes(root):
        truth = frame.truth()
        for row, extras, label in zip(find_labels(frame), truth.extras, truth.labels):
            category = folder.find_category(TABLES, row)
            assert extras["category"] == category
            assert extras["detection_name"] == CATEGORIES.get(category)
            names = [TABLES["attribute"][int(t[1:])]["name"] for t in row["attribute_tokens"]]
            assert extras["attribute"] == (names[0] if names else None)
            assert extras["points"] == row["num_lidar_pts"] + row["num_radar_pts"]
            assert tracks.setdefault(row["instance_token"], extras["track_id"]) == extras["track_id"]
            expected = {
                "vehicle.car": "Car",
                "vehicle.truck": "Truck",
                "vehicle.bicycle": "Cyclist" if names == ["cycle.with_rider"] else "Misc",
            }.get(category, "Pedestrian" if "pedestrian" in category else "Misc")
            assert label == expected
        assert len(frame.native.labels().select_bicycle_racks()) == sum(
            folder.find_category(TABLES, row) == "static_object.bicycle_rack" for row in find_labels(frame)
        )
    assert len(set(tracks.values())) == len(tracks)
    assert set(CATEGORIES.values()) == set(NAMES) and len(ATTRIBUTES) == 8


def test_order_of_table_rows_does_not_matter(root, write_changed_tables):
    def shuffle_rows(tables):
        rng = np.random.default_rng(5)
        for name, rows in tables.items():
            if name not in ("scene", "sample_annotation"):
                rng.shuffle(rows)

    assert are_equal_frames(open_nuscenes(write_changed_tables(shuffle_rows)), open_nuscenes(root))


@pytest.mark.parametrize("chunk", [1000, 1777])
def test_tables_can_be_read_in_chunks_of_any_size(root, monkeypatch, chunk):
    whole = open_nuscenes(root)
    monkeypatch.setattr(nuscenes_tables, "CHUNK_SIZE", chunk)
    monkeypatch.setattr(nuscenes_labels, "BLOCK_SIZE", 7)
    assert are_equal_frames(open_nuscenes(root), whole)


def test_single_line_and_empty_tables_are_read(tmp_path):
    (tmp_path / "v").mkdir()
    for text, rows in ('[{"a":1,"b":"x, ] y"},{"b":2,"a":0}]', [(1, "x, ] y"), (0, 2)]), (" [ ] \n", []):
        (tmp_path / "v/t.json").write_text(text)
        assert list(Tables(tmp_path, "v").read_rows("t", "a", "b")) == rows


def test_version_without_labels_has_frames(write_changed_tables):
    root = write_changed_tables(lambda tables: tables["sample_annotation"].clear())
    assert {f.truth() for f in open_nuscenes(root)} == {None}
    root = write_changed_tables(lambda tables: tables.pop("sample_annotation"), "v1.0-test")
    frames = open_nuscenes(root, "v1.0-test")
    assert len(frames) == 8 and frames[0].truth() is None


def drop_row(table, token):
    def change(tables):
        tables[table] = [row for row in tables[table] if row["token"] != token]

    return change


def set_in_first_row(table, **values):
    return lambda tables: tables[table][0].update(values)


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda t: t.pop("ego_pose"), "ego_pose.json"),
        (lambda t: t.pop("sample_annotation"), "cannot read the table .*sample_annotation.json"),
        (lambda t: t["sample"].clear(), "no key frame"),
        (lambda t: t["sample"][2].pop("timestamp"), "sample.json: row 2 has no timestamp"),
        (lambda t: t["sample"].insert(1, 7), "sample.json: row 1 has no token"),
        (set_in_first_row("sample", token="s0k1"), "sample.json has rows with the same token"),
        (drop_row("sample_data", "s0k1topTrue"), "no LIDAR_TOP for 1 of 8 key frames, such as s0k1"),
        (drop_row("ego_pose", "s0k1topTrue"), "ego_pose.json has no row s0k1topTrue"),
        (drop_row("instance", "s0o0"), "the instance s0o0 of label s0o0k"),
        (drop_row("category", "c0"), "has no category"),
        (set_in_first_row("sample_annotation", prev="gone"), "another label links to label gone, which is missing"),
        (set_in_first_row("sample_annotation", rotation=[0, 0, 0, 0]), "a rotation is not a quaternion"),
        (set_in_first_row("sample_annotation", rotation=[1e308, 0, 0, 0]), "a rotation is not a quaternion"),
        (set_in_first_row("ego_pose", rotation=[1e-200, 0, 0, 0]), "a rotation is not a quaternion"),
        (set_in_first_row("sample_annotation", num_lidar_pts=1e308), "a count of points is not 3 finite numbers"),
        (set_in_first_row("sample_annotation", attribute_tokens=[[]], size=[1, 2]), "a size is not 3 finite"),
        (set_in_first_row("sample_annotation", translation=[1, None, 2]), "a translation is not"),
        (set_in_first_row("ego_pose", translation="x"), "ego_pose.json: a translation is not 3 finite"),
        (set_in_first_row("ego_pose", rotation=[10**400, 0, 0, 0]), "ego_pose.json: a rotation is not"),
        *(
            (set_in_first_row("sample", timestamp=time), "sample.json: row 0: timestamp is not a time")
            for time in (1e38, 10**38, -1, "now", None)
        ),
        (set_in_first_row("sample_data", filename=7), "sample_data.json: row 0: filename is not a string"),
        (set_in_first_row("scene", token=[]), "scene.json: row 0: token is not a string"),
        (set_in_first_row("sample_annotation", attribute_tokens=5), "attribute_tokens is not a list"),
        (set_in_first_row("calibrated_sensor", rotation=[1, 0, 0, float("nan")]), "a rotation is not"),
    ],
)
def test_invalid_tables_are_reported(write_changed_tables, change, words):
    with pytest.raises(InputError, match=words) as caught:
        open_nuscenes(write_changed_tables(change))[0].truth()
    assert "\n" not in str(caught.value)


def test_invalid_file_name_is_reported(write_changed_tables):
    with pytest.raises(InputError, match=r"x00b' is not a valid file name"):
        for frame in open_nuscenes(
            write_changed_tables(lambda tables: [row.update(filename="a\0b") for row in tables["sample_data"]])
        ):
            frame.load()


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "",
        lambda text: "{}",
        lambda text: text.replace("token", "tok\x00en", 1),
        lambda text: text.rstrip("]\n"),
        lambda text: text.replace("[", "[" * 100_000, 2),
    ],
)
def test_damaged_tables_are_reported(write_changed_tables, damage):
    root = write_changed_tables()
    path = root / folder.VERSION / "ego_pose.json"
    path.write_text(damage(path.read_text()))
    with pytest.raises(InputError, match=r"ego_pose.json .*download the tables of v1.0") as caught:
        open_nuscenes(root)
    assert "\n" not in str(caught.value)


def test_damaged_large_table_is_not_read_to_the_end(write_changed_tables, monkeypatch):
    root = write_changed_tables()
    path = root / folder.VERSION / "ego_pose.json"
    text = json.dumps(TABLES["ego_pose"] * 50).replace("{", "{?", 1)
    path.write_bytes(text.encode() + b"\xff")  # would cause another error if it were read
    monkeypatch.setattr(nuscenes_tables, "CHUNK_SIZE", 1000)
    with pytest.raises(InputError, match=r"ego_pose.json is truncated or damaged"):
        open_nuscenes(root)


def test_wrong_folder_is_reported(root, tmp_path):
    for place, version, words in (
        (tmp_path / "none", "v1.0-mini", "none is not a folder"),
        (root, "v1.0-trainval", "no folder v1.0-trainval; its versions are: v1.0-mini"),
        (root, "", "no folder without a name"),
        (root / "samples", "v1.0-mini", "give the folder that holds v1.0-mini"),
    ):
        with pytest.raises(InputError, match=words):
            open_nuscenes(place, version)


def test_missing_or_truncated_sweep_is_reported(write_changed_tables):
    frame = open_nuscenes(write_changed_tables())[0]
    with pytest.raises(InputError, match=r"cannot read .*s0k0topTrue.pcd.bin"):
        frame.load()
    frame.points.parent.mkdir(parents=True)
    frame.points.write_bytes(bytes(50))
    with pytest.raises(InputError, match=r"50 bytes, not a multiple of 20 .* download it again"):
        frame.load()
    frame.points.write_bytes(b"")
    assert len(frame.load()) == 0


def test_real_sweep_is_read(data, write_changed_tables):
    (path,) = (data / "nuscenes").glob("*.pcd.bin")
    frame = open_nuscenes(write_changed_tables())[0]
    frame.points.parent.mkdir(parents=True)
    frame.points.symlink_to(path)
    scan = frame.load()
    assert len(read_records(path, SWEEP_COLUMNS)) == 34688 and 25_000 < len(scan) < 34688
    assert 0 <= scan.intensity.min() and 0.5 < scan.intensity.max() <= 1
    # The ground is at the height given by the calibration.
    near = np.hypot(scan.xyz[:, 0], scan.xyz[:, 1]) < 12
    heights = scan.xyz[near & (scan.xyz[:, 2] < -1), 2]
    assert np.median(heights) == pytest.approx(-folder.SENSOR[2], abs=0.15)

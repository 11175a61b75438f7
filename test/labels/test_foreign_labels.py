"""Label files of other tools: conventions of headings and corners, and unknown fields."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from format_samples import CALIBRATION, make_format_drive
from scipy.spatial.transform import Rotation

from lidar_perception.data.kitti.labels import DONT_CARE
from lidar_perception.geometry import box_corners
from lidar_perception.labels.drive_labels import DriveLabels, FrameLabels
from lidar_perception.labels.exchange import FORMATS, export_labels, import_labels, recognise_format
from lidar_perception.types import InputError

BOX = np.array([10.0, 5.0, -1.0, 4.0, 1.8, 1.5, 2.0])
HEADING = np.array([math.cos(2.0), math.sin(2.0), 0.0])


def make_one_frame():
    return make_format_drive("one", frames=1)


def export_box(format, path, box=BOX, **more):
    (frame,) = frames = make_one_frame()
    labels = FrameLabels.of(frame.name, frame.stamp_ns, [box], ["Car"], [7], [0.5], **more)
    export_labels(DriveLabels([labels]), format, path, frames)
    return path


def assert_same_points(found, expected):
    """Assert that two sets of points are the same, in any order."""
    np.testing.assert_allclose(np.sort(np.round(found, 5), axis=0), np.sort(np.round(expected, 5), axis=0), atol=1e-5)


def test_sustech_front_is_along_scale_x(tmp_path):
    (item,) = json.loads((export_box("sustech", tmp_path / "s") / "000005.json").read_text())
    psr = {k: np.array([v["x"], v["y"], v["z"]]) for k, v in item["psr"].items()}
    rotation = Rotation.from_euler("XYZ", psr["rotation"]).as_matrix()
    corners = [
        psr["position"] + rotation @ (np.array([x, y, z]) * psr["scale"] / 2)
        for x in (-1, 1)
        for y in (-1, 1)
        for z in (-1, 1)
    ]
    assert_same_points(corners, box_corners(BOX[None])[0])
    np.testing.assert_allclose(rotation[:, 0], HEADING, atol=1e-12)
    assert (item["obj_type"], item["obj_id"]) == ("Car", "7")


@pytest.mark.parametrize(("format", "degrees"), [("labelcloud", True), ("labelcloud-rel", False)])
def test_labelcloud_rotation_is_counterclockwise_from_x(format, degrees, tmp_path):
    content = json.loads((export_box(format, tmp_path / "l") / "000005.json").read_text())
    (item,) = content["objects"]
    turn = item["rotations"]["z"]
    assert turn == pytest.approx(math.degrees(2.0) if degrees else 2.0)
    assert list(item["rotations"]) == ["x", "y", "z"]  # labelCloud expects this order
    assert list(item["dimensions"].values()) == [4.0, 1.8, 1.5]
    backwards = {**item["rotations"], "z": 350.0 if degrees else -0.3}
    (tmp_path / "l/000005.json").write_text(json.dumps({**content, "objects": [{**item, "rotations": backwards}]}))
    read = import_labels(tmp_path / "l", format, make_one_frame())
    assert read.frames[0].boxes[0, 6] == pytest.approx(-math.pi / 18 if degrees else -0.3)


def test_labelcloud_vertices_give_heading_and_sides(tmp_path):
    content = json.loads((export_box("labelcloud-vertices", tmp_path / "l") / "000005.json").read_text())
    corners = np.array(content["objects"][0]["vertices"])
    assert_same_points(corners, box_corners(BOX[None])[0])
    along, across, up = (corners[k] - corners[0] for k in (3, 1, 4))  # as in labelCloud's reader
    np.testing.assert_allclose(along, 4.0 * HEADING, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm([across, up], axis=1), [1.8, 1.5], atol=1e-6)
    assert np.cross(along, across)[2] > 0 and up[2] > 0
    assert recognise_format(tmp_path / "l") == "labelcloud"  # labelCloud also reads vertices
    read = import_labels(tmp_path / "l", "labelcloud", make_one_frame())
    np.testing.assert_allclose(read.frames[0].boxes[0], BOX, atol=1e-7)


def test_openlabel_cuboid_heads_along_its_x_axis(tmp_path):
    content = json.loads(export_box("openlabel", tmp_path / "o.json").read_text())["openlabel"]
    element = content["frames"]["5"]["objects"]["7"]["object_data"]
    val = element["cuboid"][0]["val"]
    np.testing.assert_allclose(Rotation.from_quat(val[3:7]).as_matrix()[:, 0], HEADING, atol=1e-12)
    np.testing.assert_allclose([*val[:3], *val[7:]], BOX[:6], atol=1e-12)
    assert content["objects"]["7"]["type"] == "Car"
    assert content["objects"]["7"]["frame_intervals"] == [{"frame_start": 5, "frame_end": 5}]
    camera = np.array(content["coordinate_systems"]["camera"]["pose_wrt_parent"]["matrix4x4"])
    lidar_to_camera = make_one_frame()[0].calibration().lidar_to_camera
    np.testing.assert_allclose(camera.reshape(4, 4) @ lidar_to_camera, np.eye(4), atol=1e-9)


FOREIGN = {
    "openlabel": {
        "metadata": {"schema_version": "1.0.0", "annotator": "somebody"},
        "ontologies": {"0": "https://example.org/things"},
        "coordinate_systems": {
            "map": {"type": "scene_cs", "parent": "", "children": ["vehicle"]},
            "vehicle": {"type": "local_cs", "parent": "map", "children": ["velodyne_top", "front"]},
            "velodyne_top": {
                "type": "sensor_cs",
                "parent": "vehicle",
                "children": [],
                "pose_wrt_parent": {"quaternion": [0, 0, math.sin(0.25), math.cos(0.25)], "translation": [1.0, 0, 2.0]},
            },
            "front": {"type": "sensor_cs", "parent": "vehicle", "children": []},
        },
        "frames": {
            "5": {
                "frame_properties": {
                    "transforms": {
                        "vehicle_to_map": {
                            "src": "vehicle",
                            "dst": "map",
                            "transform_src_to_dst": {"matrix4x4": [1, 0, 0, 100, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]},
                        }
                    }
                },
                "objects": {
                    "6bb5f9a6-6b0f-4b3c-8d1a-2f5c1d3e4f50": {
                        "object_data": {
                            "cuboid": [
                                {
                                    "name": "shape3D",
                                    "coordinate_system": "map",
                                    "val": [111.0, 0, 2.5, 0.0, 0.0, 0.7, 4, 2, 1.5],
                                    "attributes": {"text": [{"name": "wheels", "val": "four"}]},
                                }
                            ],
                            "bbox": [{"name": "b", "val": [1, 2, 3, 4], "coordinate_system": "front"}],
                        }
                    },
                    "3": {
                        "object_data": {
                            "cuboid": [
                                {
                                    "name": "shape3D",
                                    "coordinate_system": "velodyne_top",
                                    "val": [5, 6, 7, 0.1, 0.0, 0.0, 0.995, 4, 2, 1.5],
                                }
                            ]
                        }
                    },
                    "9": {"object_data": {"bbox": [{"name": "b", "val": [5, 6, 7, 8]}]}},
                },
            }
        },
        "objects": {
            "6bb5f9a6-6b0f-4b3c-8d1a-2f5c1d3e4f50": {"name": "a", "type": "forklift"},
            "3": {"name": "b", "type": "Car", "ontology_uid": "0"},
            "9": {"name": "c", "type": "sign", "frame_intervals": [{"frame_start": 5, "frame_end": 5}]},
        },
    }
}


def test_openlabel_of_another_tool_is_transformed_and_kept(tmp_path):
    (tmp_path / "f.json").write_text(json.dumps(FOREIGN))
    frames = make_one_frame()
    labels = import_labels(tmp_path / "f.json", recognise_format(tmp_path / "f.json"), frames)
    frame_labels = labels.frames[0]
    assert frame_labels.class_names == ["forklift", "Car"]
    assert frame_labels.track_ids.tolist() == [10, 3]
    # 11 m ahead of the vehicle; the LiDAR is 1 m ahead of it and rotated by 0.5 rad to the left.
    np.testing.assert_allclose(
        frame_labels.boxes[0], [10 * math.cos(0.5), -10 * math.sin(0.5), 0.5, 4, 2, 1.5, 0.2], atol=1e-9
    )
    export_labels(labels, "openlabel", tmp_path / "again.json", frames)
    again = json.loads((tmp_path / "again.json").read_text())["openlabel"]
    old, new = (content["frames"]["5"]["objects"] for content in (FOREIGN["openlabel"], again))
    assert new == old
    for key in ("metadata", "ontologies", "coordinate_systems"):
        assert again[key] == FOREIGN["openlabel"][key]
    assert again["objects"]["3"]["ontology_uid"] == "0"
    frame_labels.boxes[:, 0] += 1.0  # moved boxes are in LiDAR coordinates
    export_labels(labels, "openlabel", tmp_path / "moved.json", frames)
    moved = import_labels(tmp_path / "moved.json", "openlabel", frames)
    np.testing.assert_allclose(moved.frames[0].boxes, frame_labels.boxes, atol=1e-9)
    assert [e["wheels"] for e in moved.frames[0].extra[:1]] == ["four"]
    flat = [
        replace(
            frame_labels,
            notes=[
                ("lane mark", {"bbox": [{"name": "seen"}]}),
                ("DontCare", {**DONT_CARE, "bbox": [1.0, 2.0, 3.0, 4.0]}),
            ],
        )
    ]  # image regions
    frames = [replace(frames[0], calibration=lambda: CALIBRATION)]
    for format in ("kitti-tracking", "kitti"):
        export_labels(DriveLabels(flat), format, tmp_path / format, frames)
        notes = import_labels(tmp_path / format, format, frames).frames[0].notes
        assert [(name, extra["bbox"]) for name, extra in notes] == [
            ("lane_mark", [0, 0, 0, 0]),
            ("DontCare", [1, 2, 3, 4]),
        ]


TILTED = {
    "sustech": [
        {
            "psr": {
                "position": {"x": 4.1, "y": -49.7, "z": 1.8},
                "scale": {"x": 4.5, "y": 1.7, "z": 1.6},
                "rotation": {"x": -0.05, "y": 0.003, "z": 1.45},
            },
            "obj_type": "ScooterRider",
            "obj_id": "front-left",
            "obj_attr": "umbrella",
            "annotator": "i",
        }
    ],
    "labelcloud": {
        "folder": "pointclouds",
        "filename": "000005.ply",
        "path": "p/000005.ply",
        "objects": [
            {
                "name": "cart",
                "centroid": {"x": -0.2, "y": -0.2, "z": 0.1},
                "dimensions": {"length": 0.75, "width": 0.55, "height": 0.15},
                "rotations": {"x": 10, "y": 350, "z": 235},
            }
        ],
    },
}


@pytest.mark.parametrize("format", TILTED)
def test_tilt_of_a_box_is_kept_until_it_is_moved(format, tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "in/000005.json").write_text(json.dumps(TILTED[format]))
    frames = make_one_frame()
    assert recognise_format(tmp_path / "in") == format
    labels = import_labels(tmp_path / "in", format, frames)
    box = labels.frames[0].boxes[0]
    turn = (
        Rotation.from_euler("XYZ", [-0.05, 0.003, 1.45])
        if format == "sustech"
        else Rotation.from_euler("ZYX", [235, 350, 10], degrees=True)
    ).as_matrix()
    assert box[6] == pytest.approx(math.atan2(turn[1, 0], turn[0, 0]))
    for other in sorted(FORMATS.keys() - {"kitti"}):  # KITTI has no track ids
        export_labels(labels, other, tmp_path / f"{format}_{other}", frames)
    export_labels(labels, format, tmp_path / "same", frames)
    assert json.loads((tmp_path / "same/000005.json").read_text()) == TILTED[format] or (format == "labelcloud")
    again = import_labels(tmp_path / "same", format, frames)
    assert again.frames[0].extra == labels.frames[0].extra and again.extra == labels.extra
    box[0] += 1.0
    export_labels(labels, format, tmp_path / "moved", frames)
    moved = import_labels(tmp_path / "moved", format, frames).frames[0]
    np.testing.assert_allclose(moved.boxes[0], box, atol=1e-8)
    assert not any("tilted" in key for key in moved.extra[0])


@pytest.mark.parametrize(
    ("format", "key"), [("sustech", "obj_id"), ("openlabel", "uid"), ("nuscenes-tracking", "tracking_id")]
)
def test_one_part_of_a_split_track_keeps_its_name(format, key, tmp_path):
    name = "0b3f7a52-5a7e-4a9b-9a3e-0d2c6f1b8e11"
    (frame,) = frames = make_one_frame()
    before = FrameLabels.of(
        frame.name,
        frame.stamp_ns,
        [BOX, BOX + [5, 0, 0, 0, 0, 0, 0]],
        ["Car", "Car"],
        [4, 8],
        extra=[{key: name}, {key: name}],
    )
    export_labels(DriveLabels([before]), format, tmp_path / "out", frames)
    after = import_labels(tmp_path / "out", format, frames).frames[0]
    assert sorted(after.track_ids.tolist()) == [8, 9]  # track names get the next free numbers
    assert [e.get(key) for e in after.extra if e] == [name]


# Axes of coordinate systems, as columns in the LiDAR frame, and the sizes along these axes of a 4 x 1.8 x 1.5 m box
# that is rotated about the vertical axis.
AXES = {
    "camera": (((0, 0, 1), (-1, 0, 0), (0, -1, 0)), (4.0, 1.5, 1.8)),
    "y up": (((0, 0, -1), (-1, 0, 0), (0, 1, 0)), (4.0, 1.5, 1.8)),
    "z down": (((1, 0, 0), (0, -1, 0), (0, 0, -1)), (4.0, 1.8, 1.5)),
    "x up": (((0, 1, 0), (0, 0, 1), (1, 0, 0)), (1.5, 4.0, 1.8)),
    "z up, y ahead": (((0, 1, 0), (-1, 0, 0), (0, 0, 1)), (4.0, 1.8, 1.5)),
}


def write_openlabel(path, systems, objects, types):
    content = {
        "metadata": {"schema_version": "1.0.0"},
        "coordinate_systems": systems,
        "objects": {uid: {"name": uid, "type": kind} for uid, kind in types.items()},
        "frames": {"5": {"objects": {uid: {"object_data": data} for uid, data in objects.items()}}},
    }
    path.write_bytes(b"\xef\xbb\xbf" + json.dumps({"openlabel": content}).encode())
    return path


def make_systems(axes, name="CAM_LEFT"):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, [0.27, 0.1, -0.08]
    return pose, {
        "VELO_TOP": {"type": "sensor_cs", "parent": ""},
        name: {"type": "sensor_cs", "parent": "VELO_TOP", "pose_wrt_parent": {"matrix4x4": pose.ravel().tolist()}},
    }


@pytest.mark.parametrize("numbers", ["euler", "quaternion"])
@pytest.mark.parametrize("case", AXES)
@pytest.mark.parametrize("turn", [0.0, 0.7, -2.9])
def test_cuboid_in_other_axes_keeps_its_sizes(tmp_path, case, numbers, turn):
    axes, sizes = AXES[case]
    pose, systems = make_systems(axes)
    angles = turn * np.abs(pose[2, :3])  # about the vertical axis
    rotation = Rotation.from_euler("xyz", angles)
    position = [0.5, 0.9, 12.0]
    shape = rotation.as_quat().tolist() if numbers == "quaternion" else angles.tolist()
    frames = make_one_frame()
    labels = import_labels(
        write_openlabel(
            tmp_path / "o.json",
            systems,
            {"1": {"cuboid": [{"name": "b", "coordinate_system": "CAM_LEFT", "val": [*position, *shape, *sizes]}]}},
            {"1": "CAR"},
        ),
        "openlabel",
        frames,
    ).frames[0]
    (box,) = labels.boxes
    np.testing.assert_allclose(box[3:6], [4.0, 1.8, 1.5])
    box_rotation = pose[:3, :3] @ rotation.as_matrix()
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    assert_same_points(
        box_corners(box[None])[0], pose[:3, 3] + (pose[:3, :3] @ position) + corners * sizes @ box_rotation.T
    )
    assert labels.class_names == ["Car"]


def test_camera_without_pose_uses_calibration_of_the_drive(tmp_path):
    frames = make_one_frame()
    path = write_openlabel(
        tmp_path / "o.json",
        {"CAM_LEFT": {"type": "sensor_cs", "parent": ""}},
        {
            "1": {
                "cuboid": [{"name": "b", "coordinate_system": "CAM_LEFT", "val": [0, 0.9, 12, 0, 0, 0, 3.9, 1.5, 1.6]}]
            }
        },
        {"1": "Car"},
    )
    (box,) = import_labels(path, "openlabel", frames).frames[0].boxes
    np.testing.assert_allclose(
        CALIBRATION.lidar_to_camera[:3, :3] @ box[:3] + CALIBRATION.lidar_to_camera[:3, 3], [0, 0.9, 12], atol=1e-9
    )
    assert box[3:6].tolist() == [3.9, 1.6, 1.5]
    with pytest.raises(InputError, match="does not define the coordinate system 'lidar'"):
        import_labels(path, "openlabel", make_format_drive("one", frames=1, camera=False))


def test_openlabel_regions_stay_regions(tmp_path):
    _, systems = make_systems(AXES["camera"][0])
    frames = make_one_frame()
    empty_cuboid = {
        "name": "box3D",
        "coordinate_system": "CAM_LEFT",
        "val": [-10, 499, -1, 0, -1, 0, -1000, -1000, -1000],
    }
    data = {
        "cuboid": [empty_cuboid],
        "num": [{"name": "occluded", "val": -1}],
        "bbox": [
            {"name": "a", "coordinate_system": "CAM_LEFT", "val": [700, 190, 40, 16]},
            {"name": "b", "coordinate_system": "CAM_LEFT", "val": [100, 200, 10, 20]},
            {"name": "c", "coordinate_system": "CAM_RIGHT", "val": [1, 1, 1, 1]},
        ],
    }
    car = {"cuboid": [{"name": "box3D", "coordinate_system": "CAM_LEFT", "val": [0, 0.9, 12, 0, 0, 0, 3.9, 1.5, 1.6]}]}
    path = write_openlabel(tmp_path / "o.json", systems, {"1": car, "-1": data}, {"1": "car", "-1": "dontcare"})
    labels = import_labels(path, "openlabel", frames)
    assert labels.frames[0].class_names == ["Car"]
    assert [(name, note["bbox"]) for name, note in labels.frames[0].notes] == [
        ("DontCare", [680, 182, 720, 198]),
        ("DontCare", [95, 190, 105, 210]),
    ]
    export_labels(labels, "kitti_object", tmp_path / "kitti", frames)
    lines = (tmp_path / "kitti/000005.txt").read_text().splitlines()
    assert lines[1:] == [
        f"DontCare -1 -1 -10 {bbox} -1 -1 -1 -1000 -1000 -1000 -10"
        for bbox in ("680.00 182.00 720.00 198.00", "95.00 190.00 105.00 210.00")
    ]
    export_labels(labels, "openlabel", tmp_path / "again.json", frames)
    again = json.loads((tmp_path / "again.json").read_text())["openlabel"]
    assert again["frames"]["5"]["objects"] == {"1": {"object_data": car}, "-1": {"object_data": data}}
    assert [o["type"] for o in again["objects"].values()] == ["car", "dontcare"]


POSE = "<item><tx>12</tx><ty>0</ty><tz>-1.7</tz><rz>0.1</rz></item>"
TRACK = (
    "<item><objectType>{}</objectType><h>1.5</h><w>1.6</w><l>3.9</l><first_frame>{}"
    "</first_frame><poses>{}</poses></item>"
)


def write_tracklets(path, *tracks):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"<boost_serialization><tracklets>{''.join(tracks)}</tracklets></boost_serialization>")
    return path


def test_cvat_tracklets_are_read(tmp_path):
    frames = make_format_drive("one")  # numbers 5 to 7
    path = write_tracklets(
        tmp_path / "in/tracklet_labels.xml", TRACK.format("car", 5, POSE * 2), TRACK.format("bus", 7, POSE)
    )
    for given in (path, path.parent):
        assert recognise_format(given) == "kitti-raw"
        labels = import_labels(given, "kitti_raw", frames)
        assert [each.class_names for each in labels.frames] == [["Car"], ["Car"], ["bus"]]
        assert [each.track_ids.tolist() for each in labels.frames] == [[0], [0], [1]]
        np.testing.assert_allclose(labels.frames[0].boxes[0], [12, 0, -0.95, 3.9, 1.6, 1.5, 0.1])
    (path.parent / "frame_list.txt").write_text("7 000005\n5 000006\n6 000007\n")
    labels = import_labels(path, "kitti-raw", frames)
    assert [each.class_names for each in labels.frames] == [["bus"], ["Car"], ["Car"]]
    write_tracklets(path, TRACK.format("Car", 9, POSE))
    with pytest.raises(InputError, match=r"has labels of frame 9 .* the drive has frames 5 to 7"):
        import_labels(path, "kitti-raw", frames)
    several = make_format_drive("several")
    with pytest.raises(InputError, match="is a single file, but the frames belong to 2 drives"):
        import_labels(path, "kitti-raw", several)
    with pytest.raises(InputError, match="has no tracklet_labels"):
        import_labels(path.parent, "kitti-raw", several)
    write_tracklets(tmp_path / "in/0011/tracklet_labels.xml", TRACK.format("Van", 5, POSE))
    labels = import_labels(path.parent, "kitti-raw", several)
    assert [name for each in labels.frames for name in each.class_names] == ["Van"]


def test_openpcdet_labels_are_read(tmp_path):
    frames = make_format_drive("one")
    folder = tmp_path / "labels"
    folder.mkdir()
    (folder / "000006.txt").write_bytes(
        b"\xef\xbb\xbf12.0 0 -0.98 3.9 1.6 1.5 0.1 Vehicle\r\n1 2 0 1 1 2 0 e-scooter\r\n"
    )
    for given in (folder, tmp_path):
        assert recognise_format(given) == "openpcdet"
        labels = import_labels(given, "openpcdet", frames)
        assert [each.class_names for each in labels.frames] == [[], ["Car", "e-scooter"], []]
    assert labels.frames[1].boxes[0].tolist() == [12, 0, -0.98, 3.9, 1.6, 1.5, 0.1]
    with pytest.raises(InputError, match="unknown format 'openpcdet'"):
        export_labels(labels, "openpcdet", tmp_path / "out", frames)

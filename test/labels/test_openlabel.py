"""OpenLABEL files of other tools: coordinate systems, cameras and regions."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from format_samples import BOX, CALIBRATION, HEADING, assert_same_points, export_box, make_format_drive, make_one_frame
from scipy.spatial.transform import Rotation

from lidar_perception.data.kitti.labels import DONT_CARE
from lidar_perception.geometry import box_corners
from lidar_perception.labels.drive_labels import DriveLabels
from lidar_perception.labels.exchange import export_labels, import_labels, recognise_format
from lidar_perception.types import InputError


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
    exported = json.loads((tmp_path / "again.json").read_text())["openlabel"]
    old, new = (content["frames"]["5"]["objects"] for content in (FOREIGN["openlabel"], exported))
    assert new == old
    for key in ("metadata", "ontologies", "coordinate_systems"):
        assert exported[key] == FOREIGN["openlabel"][key]
    assert exported["objects"]["3"]["ontology_uid"] == "0"
    frame_labels.boxes[:, 0] += 1.0  # moved boxes are in LiDAR coordinates
    export_labels(labels, "openlabel", tmp_path / "moved.json", frames)
    moved_labels = import_labels(tmp_path / "moved.json", "openlabel", frames)
    np.testing.assert_allclose(moved_labels.frames[0].boxes, frame_labels.boxes, atol=1e-9)
    assert [e["wheels"] for e in moved_labels.frames[0].extra[:1]] == ["four"]
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
    exported = json.loads((tmp_path / "again.json").read_text())["openlabel"]
    assert exported["frames"]["5"]["objects"] == {"1": {"object_data": car}, "-1": {"object_data": data}}
    assert [o["type"] for o in exported["objects"].values()] == ["car", "dontcare"]

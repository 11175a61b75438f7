"""Label files of other tools: conventions of headings and corners, and unknown fields."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from format_samples import BOX, HEADING, assert_same_points, export_box, make_format_drive, make_one_frame
from scipy.spatial.transform import Rotation

from lidar_perception.geometry import box_corners
from lidar_perception.labels.drive_labels import DriveLabels, FrameLabels
from lidar_perception.labels.exchange import FORMATS, export_labels, import_labels, recognise_format
from lidar_perception.types import InputError


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
    unmoved_labels = import_labels(tmp_path / "same", format, frames)
    assert unmoved_labels.frames[0].extra == labels.frames[0].extra and unmoved_labels.extra == labels.extra
    box[0] += 1.0
    export_labels(labels, format, tmp_path / "moved", frames)
    moved_frame = import_labels(tmp_path / "moved", format, frames).frames[0]
    np.testing.assert_allclose(moved_frame.boxes[0], box, atol=1e-8)
    assert not any("tilted" in key for key in moved_frame.extra[0])


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
    for source in (path, path.parent):
        assert recognise_format(source) == "kitti-raw"
        labels = import_labels(source, "kitti_raw", frames)
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
    for source in (folder, tmp_path):
        assert recognise_format(source) == "openpcdet"
        labels = import_labels(source, "openpcdet", frames)
        assert [each.class_names for each in labels.frames] == [[], ["Car", "e-scooter"], []]
    assert labels.frames[1].boxes[0].tolist() == [12, 0, -0.98, 3.9, 1.6, 1.5, 0.1]
    with pytest.raises(InputError, match="unknown format 'openpcdet'"):
        export_labels(labels, "openpcdet", tmp_path / "out", frames)

"""The intensity scale of a recording is the same for all frames, in any order."""

from __future__ import annotations

import numpy as np
import pytest
from bag_samples import cloud_frame
from cli_samples import run_main
from samples import STAMP, make_calibration_text, write_file

from lidar_perception.data.bag import BagWriter
from lidar_perception.data.frame import Frame
from lidar_perception.data.levelling import SensorMount, level_frame
from lidar_perception.data.open import open_recording
from lidar_perception.data.semantickitti import write_scan
from lidar_perception.data.to_bag import write_bag
from lidar_perception.wire.codec import make_bag_message
from msg_utils.point_cloud2 import from_array
from msg_utils.stamps import make_header

COUNT = 5


def make_clouds(full, whole=False):
    """Yield clouds (50, 4) [x y z intensity] of a sensor with maximum intensity `full`; the first one is dark."""
    rng = np.random.default_rng(0)
    for i in range(COUNT):
        cloud = rng.uniform([3, -9, -1, 0], [30, 9, 1, 1], (50, 4))
        cloud[0, 3] = 1.0
        cloud[:, 3] *= full if i else min(1.2, full)
        cloud[:, 3] = np.round(cloud[:, 3]) if whole else cloud[:, 3]
        yield i, cloud.astype(np.float32)


def write_object_files(root, clouds):
    for i, cloud in clouds:
        write_file(root / f"training/velodyne/{i:06}.bin", cloud.tobytes())
        write_file(root / f"training/calib/{i:06}.txt", make_calibration_text())


def write_tracking_files(root, clouds):
    for i, cloud in clouds:
        write_file(root / f"training/velodyne/{i // 3:04}/{i:06}.bin", cloud.tobytes())
        write_file(root / f"training/calib/{i // 3:04}.txt", make_calibration_text())
    (root / "training/label_02").mkdir()


def write_raw_files(root, clouds):
    drive = root / "2011_09_26/2011_09_26_drive_0001_sync/velodyne_points"
    for i, cloud in clouds:
        write_file(drive / f"data/{i:010}.bin", cloud.tobytes())
    write_file(drive / "timestamps.txt", "".join(f"2011-09-26 13:02:2{i}.0\n" for i in range(COUNT)))


def write_semantic_files(root, clouds):
    for i, cloud in clouds:
        write_scan(root / "sequences/00", i, cloud, np.zeros(50), np.zeros(50))


def write_bin_files(root, clouds):
    for i, cloud in clouds:
        write_file(root / f"{i}.bin", cloud.tobytes())


def write_npy_files(root, clouds):
    for i, cloud in clouds:
        np.save(root / f"{i}.npy", cloud)


def write_pcd_files(root, clouds):
    for i, cloud in clouds:
        write_file(
            root / f"{i}.pcd",
            (
                b"VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
                b"WIDTH 50\nHEIGHT 1\nPOINTS 50\nDATA binary\n"
            )
            + cloud.tobytes(),
        )


def write_bag_files(root, clouds):
    write_bag(root / "drive", [Frame.of(str(i), cloud_frame(cloud, STAMP + i * 10**8)) for i, cloud in clouds])


LAYOUTS = {
    each.__name__.removeprefix("write_"): each
    for each in (
        write_object_files,
        write_tracking_files,
        write_raw_files,
        write_semantic_files,
        write_bin_files,
        write_npy_files,
        write_pcd_files,
        write_bag_files,
    )
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize(
    "full, whole", [(1, False), (100, False), (255, False), (255, True), (1023, True), (65535, True)]
)
def test_scale_does_not_depend_on_order_of_frames(tmp_path, layout, full, whole):
    LAYOUTS[layout](tmp_path, make_clouds(full, whole))
    path = tmp_path / "drive" if layout == "bag_files" else tmp_path
    expected = [cloud[:, 3] / np.float32(full) for _, cloud in make_clouds(full, whole)]
    for order in (range(COUNT), [COUNT - 1, 0, 2, 1, 3]):
        frames = open_recording(path).frames
        for i in order:
            scan = frames[i].load()
            assert scan.intensity.tobytes() == expected[i].tobytes()
            assert frames[i].intensity_max() == full
    assert np.array_equal(next(iter(open_recording(path))).load().intensity, expected[0])
    if layout in ("bin_files", "pcd_files", "bag_files"):  # as `convert --robot` does
        assert np.array_equal(level_frame(frames[0], SensorMount()).load().intensity, expected[0])
        intensity = level_frame(frames[0], SensorMount(intensity_max=10.0)).load().intensity
        assert np.allclose(intensity, expected[0] * full / 10)


@pytest.mark.parametrize(
    "kind, values, full",
    [
        ("u1", [0, 3, 90], 255),
        ("<u2", [0, 3, 200], 255),
        ("<u2", [0, 3, 3000], 4095),
        ("<u2", [0, 3, 60000], 65535),
        ("<f4", [np.nan, -1, 0.5], 1),
        ("<f4", [0, 0, 0], 1),
        ("<f8", [7, 7, 7], 255),
    ],
)
def test_scale_depends_on_the_type_of_the_field(tmp_path, kind, values, full):
    points = np.ones(3, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("reflectivity", kind)])
    points["reflectivity"] = values
    with BagWriter(tmp_path / "drive") as writer:
        writer.add_topic("/points", "sensor_msgs/msg/PointCloud2")
        for i in (1, 2):
            stamped = make_header(i * 10**8, "lidar", make_bag_message)
            writer.write("/points", i * 10**8, from_array(points, stamped, make_bag_message))
    expected = np.where(np.asarray(values, float) > 0, values, 0).astype(np.float32)
    for frame in open_recording(tmp_path / "drive"):
        assert np.array_equal(frame.load().intensity, expected / np.float32(full))


def test_empty_and_black_clouds_do_not_affect_the_scale(tmp_path):
    xyz = np.ones((50, 3))
    first = [np.zeros((0, 4), np.float32), np.column_stack([xyz, np.zeros(50)])] * 8
    rest = [cloud for _, cloud in make_clouds(255)]
    write_bag(
        tmp_path / "drive",
        [
            Frame.of(str(i), cloud_frame(cloud.astype(np.float32), STAMP + i * 10**8))
            for i, cloud in enumerate([*first, *rest])
        ],
    )
    frames = open_recording(tmp_path / "drive").frames
    assert not frames[1].load().intensity.any() and frames[-1].load().intensity.max() == 1.0


def test_invalid_cloud_does_not_affect_the_scale(tmp_path):
    write_object_files(tmp_path, make_clouds(255))
    write_file(tmp_path / "training/velodyne/000004.bin", b"cut")
    frames = open_recording(tmp_path).frames
    assert frames[1].load().intensity.max() == 1.0
    (tmp_path / "training/velodyne/000003.bin").unlink()
    assert frames[0].load().intensity.max() == np.float32(1.2) / np.float32(255)


def test_commands_report_the_scale_and_export_unit_intensity(tmp_path, monkeypatch, capfd):
    write_object_files(tmp_path / "own", make_clouds(255))
    assert run_main(monkeypatch, "convert", tmp_path / "own", "--out", tmp_path / "own.bag") == 0
    assert "intensity 0 .. 255, read as 0 .. 1" in capfd.readouterr().err
    assert open_recording(tmp_path / "own.bag").frames[1].load().intensity.max() == 1.0
    assert run_main(monkeypatch, "info", tmp_path / "own") == 0
    assert "0 .. 255 in the files" in " ".join(capfd.readouterr().out.split())
    dark = np.tile(next(make_clouds(0.01))[1], (30, 1))
    write_object_files(tmp_path / "dark", [(0, dark)])
    assert run_main(monkeypatch, "convert", tmp_path / "dark", "--out", tmp_path / "dark.bag") == 0
    output = " ".join(capfd.readouterr().err.split())
    assert (
        "the highest intensity is 0.01, but a full reflection should be 1" in output and "input.intensity_max" in output
    )

"""Small sound files of every format that a command reads: what the campaign damages."""

from __future__ import annotations

import io
import json
import sys
from contextlib import redirect_stdout
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.convert.converter import convert
from rosbags.typesys import Stores, get_typestore

from lidar_perception.campaign.files import LABELS
from lidar_perception.campaign.good import PERSON, STAMP, street
from lidar_perception.candidates.configurations import BEST_VALUES
from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti import write as kitti
from lidar_perception.data.open import open_recording
from lidar_perception.data.semantickitti import calibration_text, pose_line, write_scan
from lidar_perception.data.to_bag import write_bag
from lidar_perception.detectors.pointpillars.network import load_network
from lidar_perception.detectors.pointpillars.onnx import export_onnx
from lidar_perception.detectors.pointpillars.params import PointPillarsParams
from lidar_perception.detectors.pointpillars.weights_file import weights_file
from lidar_perception.labels.drive_labels import DriveLabels, of_truth
from lidar_perception.labels.exchange import export_labels
from lidar_perception.runs.files import write_bytes, write_text
from lidar_perception.simulation.camera import FORWARD_CAMERA
from lidar_perception.types import PEDESTRIAN, GroundTruth, InputError, LidarFrame

FRAMES = 2
CAR = np.array([14.0, 5.0, -0.9, 4.2, 1.7, 1.5, 0.3])
TRUTH = GroundTruth.of([PERSON, CAR], [PEDESTRIAN, 0], [
    {"track_id": i, "truncated": 0.0, "occluded": 0, "alpha": 0.1,
     "bbox": [600.0, 150.0, 700.0, 300.0]} for i in range(2)])


def scan(number: int) -> np.ndarray:
    """(N, 4) float32 [x y z intensity]."""
    xyz = street(number)
    return np.column_stack([xyz, np.full(len(xyz), 0.4)]).astype(np.float32)


def as_ros1(source: Path, path: Path, compress: str | None = None) -> Path:
    """A copy of a bag for ROS 1, as rosbags writes it; compress: lz4, bz2 or None."""
    with redirect_stdout(io.StringIO()):
        convert([source], path, "", 0, compress, "", None, get_typestore(Stores.ROS1_NOETIC),
                (), (), (), ())
    return path


def write_samples(root: Path) -> None:
    """A folder for each format but ONNX, the same bytes on every machine."""
    for i in range(FRAMES):
        kitti.write_object(root / "kitti", i, scan(i), TRUTH, FORWARD_CAMERA)
        kitti.write_velodyne(root / f"tracking/training/velodyne/0000/{i:06}.bin", scan(i))
        write_scan(root / "semantickitti/sequences/00", i, scan(i),
                   np.full(len(street(i)), 40, np.uint32), np.zeros(len(street(i)), np.uint32))
    tracking = root / "tracking/training"
    write_text(tracking / "label_02/0000.txt", "".join(
        kitti.tracking_label_text(i, TRUTH, FORWARD_CAMERA) for i in range(FRAMES)).strip())
    write_text(tracking / "calib/0000.txt", kitti.calibration_text(FORWARD_CAMERA))
    sequence = root / "semantickitti/sequences/00"
    write_text(sequence / "poses.txt", pose_line(np.eye(4), FORWARD_CAMERA) * FRAMES)
    write_text(sequence / "times.txt", "0.0\n0.1")
    write_text(sequence / "calib.txt", calibration_text(FORWARD_CAMERA))
    write_bag(root / "bag/drive", [Frame.of(str(i), LidarFrame(
        street(i), np.full(len(street(i)), 0.4, np.float32), STAMP + i * 10**8, "lidar"), TRUTH,
        FORWARD_CAMERA, pose=lambda: np.eye(4)) for i in range(FRAMES)])
    _labels(root)
    write_text(root / "pcd/0.pcd", "\n".join([
        "VERSION 0.7", "FIELDS x y z intensity", "SIZE 4 4 4 4", "TYPE F F F F", "COUNT 1 1 1 1",
        "WIDTH 20", "HEIGHT 1", "POINTS 20", "DATA ascii",
        *(" ".join(map(str, point)) for point in scan(0)[:20].tolist())]))
    (root / "ros1").mkdir()
    as_ros1(root / "bag/drive", root / "ros1/drive.bag", "lz4")
    _nuscenes(root / "nuscenes")
    labels = (root / "kitti/training/label_2/000000.txt").read_text()
    for i in range(FRAMES):
        write_text(root / f"results/{i:06}.txt",
                   "".join(f"{line} 0.9\n" for line in labels.splitlines()))
    write_text(root / "split/split.txt", "000001\n000000")
    package = files("lidar_perception")
    write_bytes(root / "template/seed.json",
                (package / "candidates/pedestrian.json").read_bytes())
    write_bytes(root / "fused/fused.json", (
        package / "detectors/fused/fusion.json").read_bytes())
    write_text(root / "yaml/best.yaml", _yaml(BEST_VALUES))
    write_bytes(root / "sensor/mine.yaml", (
        package / "simulation/sensors/vlp-16.yaml").read_bytes())
    for name in ("pointpillars_v0_compact", "pointnet"):
        write_bytes(root / f"weights/{name}.safetensors", (
            package / f"detectors/{name.partition('_')[0]}/weights/{name}.safetensors"
        ).read_bytes())
    write_bytes(root / "pth/weights.pth", _pth())


def _labels(root: Path) -> None:
    drive = open_recording(root / "bag/drive").frames
    labels = DriveLabels(list(map(of_truth, drive)))
    for format, place in LABELS.items():
        export_labels(labels, format, root / place, drive)


def _yaml(values: dict[str, Any]) -> str:
    lines = [f"    {name}: {json.dumps(value)}" for name, value in values.items()]
    return "\n".join(["perception:", "  ros__parameters:", *lines])


def _pth() -> bytes:
    """A file as OpenPCDet saves it, of a few tensors."""
    import torch
    stream = io.BytesIO()
    torch.save({"model_state": {
        "vfe.pfn_layers.0.linear.weight": torch.ones(64, 10),
        "backbone_2d.blocks.0.1.weight": torch.ones(64, 64, 3, 3),
        "dense_head.conv_cls.weight": torch.ones(18, 384, 1, 1)}}, stream)
    return stream.getvalue()


def write_onnx(root: Path) -> None:
    """PointPillars as exported, which takes a while; no model at all without the extra [onnx]."""
    path = root / "onnx/weights.onnx"
    path.parent.mkdir(parents=True)
    header, network = load_network(weights_file(PointPillarsParams()))
    try:
        export_onnx(network.eval(), header, path)
    except InputError:
        path.write_bytes(b"\x08\x07")


def _nuscenes(root: Path) -> None:
    """One scene of nuScenes' v1.0-mini."""
    def row(token: str, **values: Any) -> dict[str, Any]:
        return {"token": token, **values}

    level, none = [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    times = [1_532_402_927_000_000 + 500_000 * i for i in range(FRAMES)]
    near = {"prev": "", "next": ""}
    tables = {
        "category": [row("c0", name="human.pedestrian.adult")],
        "attribute": [row("a0", name="pedestrian.moving")],
        "sensor": [row("top", channel="LIDAR_TOP", modality="lidar")],
        "calibrated_sensor": [row("mount", sensor_token="top", translation=[0.9, 0.0, 1.84],
                                  rotation=[0.7071, 0.0, 0.0, -0.7071], camera_intrinsic=[])],
        "scene": [row("s0", name="scene-0103", nbr_samples=FRAMES, log_token="", description="",
                      first_sample_token="k0", last_sample_token=f"k{FRAMES - 1}")],
        "sample": [row(f"k{i}", timestamp=t, scene_token="s0", prev=f"k{i - 1}" if i else "",
                       next=f"k{i + 1}" if i < FRAMES - 1 else "") for i, t in enumerate(times)],
        "sample_data": [row(f"d{i}", sample_token=f"k{i}", ego_pose_token=f"e{i}", timestamp=t,
                            calibrated_sensor_token="mount", fileformat="pcd", is_key_frame=True,
                            height=0, width=0, filename=f"samples/LIDAR_TOP/{i}.pcd.bin", **near)
                        for i, t in enumerate(times)],
        "ego_pose": [row(f"e{i}", timestamp=t, translation=[600.0 + i, 1600.0, 0.0],
                         rotation=level) for i, t in enumerate(times)],
        "instance": [row("o0", category_token="c0", nbr_annotations=FRAMES,
                         first_annotation_token="n0", last_annotation_token=f"n{FRAMES - 1}")],
        "sample_annotation": [row(f"n{i}", sample_token=f"k{i}", instance_token="o0",
                                  visibility_token="", attribute_tokens=["a0"],
                                  translation=[610.0 + i, 1600.0, 0.9], size=[0.6, 0.6, 1.8],
                                  rotation=level, num_lidar_pts=50, num_radar_pts=0, **near)
                              for i in range(FRAMES)],
        "log": [], "visibility": [], "map": [row("map", log_tokens=none, filename="map.json")],
    }
    for name, rows in tables.items():
        write_text(root / f"v1.0-mini/{name}.json", json.dumps(rows, indent=0))
    for i in range(FRAMES):
        cloud = scan(i)
        write_bytes(root / f"samples/LIDAR_TOP/{i}.pcd.bin", np.column_stack(
            [cloud[:, 1], -cloud[:, 0], cloud[:, 2], 100 * cloud[:, 3], cloud[:, 3]]
        ).astype(np.float32).tobytes())


if __name__ == "__main__":
    {"write_samples": write_samples, "write_onnx": write_onnx}[sys.argv[1]](Path(sys.argv[2]))

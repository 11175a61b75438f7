"""Small valid files of every format that a command reads."""

from __future__ import annotations

import io
import json
import sys
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import nuscenes_folder
from bag_samples import as_ros1

from fuzz.files import LABELS
from fuzz.valid_messages import PERSON, STAMP, make_points
from lidar_perception.candidates.configurations import BEST_VALUES
from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti import write as kitti
from lidar_perception.data.open import open_recording
from lidar_perception.data.semantickitti import format_calibration, format_pose, write_scan
from lidar_perception.data.to_bag import write_bag
from lidar_perception.labels.drive_labels import DriveLabels, read_frame_labels
from lidar_perception.labels.exchange import export_labels
from lidar_perception.runs.files import write_bytes, write_text
from lidar_perception.simulation.camera import FORWARD_CAMERA
from lidar_perception.types import PEDESTRIAN, GroundTruth, PointCloud

FRAMES = 2
CAR = np.array([14.0, 5.0, -0.9, 4.2, 1.7, 1.5, 0.3])
TRUTH = GroundTruth.of(
    [PERSON, CAR],
    [PEDESTRIAN, 0],
    [
        {"track_id": i, "truncated": 0.0, "occluded": 0, "alpha": 0.1, "bbox": [600.0, 150.0, 700.0, 300.0]}
        for i in range(2)
    ],
)


def scan(number: int) -> np.ndarray:
    """Return points (N, 4) float32 [x y z intensity]."""
    xyz = make_points(number)
    return np.column_stack([xyz, np.full(len(xyz), 0.4)]).astype(np.float32)


def write_samples(root: Path) -> None:
    """Write a folder for each format, the same bytes on every machine."""
    for i in range(FRAMES):
        kitti.write_object(root / "kitti", i, scan(i), TRUTH, FORWARD_CAMERA)
        kitti.write_velodyne(root / f"tracking/training/velodyne/0000/{i:06}.bin", scan(i))
        count = len(make_points(i))
        write_scan(
            root / "semantickitti/sequences/00", i, scan(i), np.full(count, 40, np.uint32), np.zeros(count, np.uint32)
        )
    tracking = root / "tracking/training"
    write_text(
        tracking / "label_02/0000.txt",
        "".join(kitti.format_tracking_labels(i, TRUTH, FORWARD_CAMERA) for i in range(FRAMES)).strip(),
    )
    write_text(tracking / "calib/0000.txt", kitti.format_calibration(FORWARD_CAMERA))
    sequence = root / "semantickitti/sequences/00"
    write_text(sequence / "poses.txt", format_pose(np.eye(4), FORWARD_CAMERA) * FRAMES)
    write_text(sequence / "times.txt", "0.0\n0.1")
    write_text(sequence / "calib.txt", format_calibration(FORWARD_CAMERA))
    write_bag(
        root / "bag/drive",
        [
            Frame.of(
                str(i),
                PointCloud(make_points(i), np.full(len(make_points(i)), 0.4, np.float32), STAMP + i * 10**8, "lidar"),
                TRUTH,
                FORWARD_CAMERA,
                pose=lambda: np.eye(4),
            )
            for i in range(FRAMES)
        ],
    )
    drive = open_recording(root / "bag/drive").frames
    for format, place in LABELS.items():
        export_labels(DriveLabels(list(map(read_frame_labels, drive))), format, root / place, drive)
    write_text(
        root / "pcd/0.pcd",
        "\n".join(
            [
                "VERSION 0.7",
                "FIELDS x y z intensity",
                "SIZE 4 4 4 4",
                "TYPE F F F F",
                "COUNT 1 1 1 1",
                "WIDTH 20",
                "HEIGHT 1",
                "POINTS 20",
                "DATA ascii",
                *(" ".join(map(str, point)) for point in scan(0)[:20].tolist()),
            ]
        ),
    )
    _write_other_layouts(root)
    (root / "ros1").mkdir()
    as_ros1(root / "bag/drive", root / "ros1/drive.bag", "lz4")
    nuscenes_folder.save(
        root / "nuscenes", nuscenes_folder.make_tables(frames=FRAMES, objects=2, scenes=nuscenes_folder.SCENES[:1])
    )
    labels = (root / "kitti/training/label_2/000000.txt").read_text()
    for i in range(FRAMES):
        write_text(root / f"results/{i:06}.txt", "".join(f"{line} 0.9\n" for line in labels.splitlines()))
    write_text(root / "split/split.txt", "000001\n000000")
    package = files("lidar_perception")
    write_bytes(root / "template/seed.json", (package / "candidates/pedestrian.json").read_bytes())
    write_bytes(root / "fused/fused.json", (package / "detectors/fused/fusion.json").read_bytes())
    write_text(root / "yaml/best.yaml", _write_yaml(BEST_VALUES))
    write_bytes(root / "sensor/mine.yaml", (package / "simulation/sensors/vlp-16.yaml").read_bytes())
    for name in ("pointpillars_v0_compact", "pointnet"):
        write_bytes(
            root / f"weights/{name}.safetensors",
            (package / f"detectors/{name.partition('_')[0]}/weights/{name}.safetensors").read_bytes(),
        )
    write_bytes(root / "pth/weights.pth", _make_pth())


def _write_other_layouts(root: Path) -> None:
    """Write clouds and labels in the layouts of other tools."""
    cloud = scan(0)[:200]
    for folder in ("npy", "openpcdet/points", "ply"):
        (root / folder).mkdir(parents=True)
    np.save(root / "npy/0.npy", cloud)
    np.save(root / "openpcdet/points/0.npy", cloud)
    write_text(root / "openpcdet/labels/0.txt", "14 5 -0.9 4.2 1.7 1.5 0.3 Vehicle")
    write_bytes(
        root / "ply/0.ply",
        (
            f"ply\nformat binary_big_endian 1.0\nelement vertex {len(cloud)}\nproperty float x\n"
            "property float y\nproperty float z\nproperty float intensity\nend_header\n"
        ).encode()
        + cloud.astype(">f4").tobytes(),
    )
    sequence = root / "odometry/dataset/sequences/00"
    kitti.write_velodyne(sequence / "velodyne/000000.bin", cloud)
    write_text(sequence / "calib.txt", format_calibration(FORWARD_CAMERA))
    write_text(sequence / "times.txt", "0.0")
    write_text(root / "odometry/dataset/poses/00.txt", format_pose(np.eye(4), FORWARD_CAMERA))
    kitti.write_velodyne(root / "raw/velodyne_points/data/0000000000.bin", cloud)
    write_text(root / "raw/velodyne_points/timestamps.txt", "2011-09-26 13:02:25.594360375")
    write_text(root / "raw/frame_list.txt", "0 0000000000")
    write_text(
        root / "raw/tracklet_labels.xml",
        (
            "<boost_serialization><tracklets><item><objectType>car</objectType><h>1.5</h><w>1.7</w>"
            "<l>4.2</l><first_frame>0</first_frame><poses><item><tx>14</tx><ty>5</ty><tz>-1.7</tz>"
            "<rz>0.3</rz></item></poses></item></tracklets></boost_serialization>"
        ),
    )


def _write_yaml(values: dict[str, Any]) -> str:
    lines = [f"    {name}: {json.dumps(value)}" for name, value in values.items()]
    return "\n".join(["perception:", "  ros__parameters:", *lines])


def _make_pth() -> bytes:
    """Return a checkpoint in OpenPCDet's format with a few tensors."""
    import torch

    stream = io.BytesIO()
    torch.save(
        {
            "model_state": {
                "vfe.pfn_layers.0.linear.weight": torch.ones(64, 10),
                "backbone_2d.blocks.0.1.weight": torch.ones(64, 64, 3, 3),
                "dense_head.conv_cls.weight": torch.ones(18, 384, 1, 1),
            }
        },
        stream,
    )
    return stream.getvalue()


if __name__ == "__main__":
    write_samples(Path(sys.argv[1]))

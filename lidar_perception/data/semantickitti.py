"""SemanticKITTI folders: KITTI odometry scans with a class and an instance for every point."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.kitti.folder import PERIOD_NS, START_NS, read_velodyne
from lidar_perception.data.kitti.write import numbers, write_velodyne
from lidar_perception.runs.files import write_bytes
from lidar_perception.types import InputError, LidarFrame, usable_returns
from lidar_perception.wire.topics import LIDAR_FRAME

UNLABELLED = (0, 1)  # unlabelled; outlier, such as a reflection: nobody knows what these points are
# road, parking, sidewalk, other-ground, lane-marking, terrain
GROUND = (40, 44, 48, 49, 60, 72)
VEGETATION = 70      # from grass to tree tops, so neither ground nor not ground as a whole
# Classes with instances. The moving ones (252 to 259) are the same things under another number.
THINGS = {10: "car", 11: "bicycle", 13: "bus", 15: "motorcycle", 16: "on-rails", 18: "truck",
          20: "other-vehicle", 30: "person", 31: "bicyclist", 32: "motorcyclist"}
MOVING = {252: 10, 253: 31, 254: 30, 255: 32, 256: 16, 257: 13, 258: 18, 259: 20}


@dataclass(frozen=True)
class SemanticFrame:
    """One labelled scan; nothing is read before load()."""

    name: str
    points: Path
    labels: Path
    stamp_ns: int

    def load(self) -> tuple[LidarFrame, np.ndarray, np.ndarray]:
        """The frame of N usable points, their classes (N,) uint16 (0 = unlabelled) and instances
        (N,) uint16 (0 = none). InputError where a file is missing, cut or of another scan."""
        cloud, labels = read_velodyne(self.points), _read_labels(self.labels)
        if len(labels) != len(cloud):
            raise InputError(f"{self.labels} has {len(labels)} labels for the {len(cloud)} points "
                             f"of {self.points}; download both again")
        usable = usable_returns(cloud[:, :3])
        cloud, labels = cloud.compress(usable, axis=0), labels.compress(usable)
        frame = LidarFrame(np.ascontiguousarray(cloud[:, :3]), cloud[:, 3].copy(), self.stamp_ns,
                           LIDAR_FRAME)
        return frame, (labels & 0xFFFF).astype(np.uint16), (labels >> 16).astype(np.uint16)


def open_semantic_kitti(root: str | Path) -> list[SemanticFrame]:
    """The labelled scans of ROOT/sequences/NN or ROOT/dataset/sequences/NN, in order; only the
    file lists are read. Sequences without a labels folder, as the test ones, are left out.
    InputError says what is missing."""
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"{root} is not a folder; give the folder of a SemanticKITTI download")
    folder = root / "dataset" if (root / "dataset/sequences").is_dir() else root
    scans = [(sequence, scan) for sequence in sorted(folder.glob("sequences/*/"))
             for scan in sorted(sequence.glob("velodyne/*.bin"))]
    if not scans:
        raise InputError(f"{root} has no SemanticKITTI scans: expected "
                         "sequences/00/velodyne/*.bin beside sequences/00/labels/*.label")
    frames = [SemanticFrame(f"{sequence.name}/{scan.stem}", scan,
                            sequence / f"labels/{scan.stem}.label", START_NS + i * PERIOD_NS)
              for i, (sequence, scan) in enumerate(scans) if (sequence / "labels").is_dir()]
    if not frames:
        raise InputError(f"{root} has scans but no labels: expected "
                         "sequences/00/labels/*.label; download the labels of SemanticKITTI too")
    return frames


def _read_labels(path: Path) -> np.ndarray:
    """(N,) uint32 of a .label file: class in the lower half, instance in the upper."""
    try:
        raw = np.fromfile(path, np.uint32)
        size = path.stat().st_size
    except OSError as error:
        raise InputError(f"cannot read the labels {path}: {error.strerror}; download them "
                         "again") from None
    if size % 4:
        raise InputError(f"{path} has {size} bytes, not a multiple of 4 (one uint32 a point); it "
                         "was cut, download it again")
    return raw


def write_scan(folder: Path, number: int, cloud: np.ndarray, semantic: np.ndarray,
               instance: np.ndarray) -> None:
    """velodyne and labels of one scan of a sequence's folder: cloud (N, 4), semantic and instance
    (N,) below 65536."""
    labels = np.asarray(instance, np.uint32) << 16 | np.asarray(semantic, np.uint32)
    write_velodyne(folder / f"velodyne/{number:06}.bin", cloud)
    write_bytes(folder / f"labels/{number:06}.label", labels.tobytes())


def pose_line(pose: np.ndarray, calibration: Calibration) -> str:
    """The line of poses.txt of a scan; pose (4, 4) is the LiDAR's frame in that of the first scan
    of the sequence, the file has the camera's."""
    to_camera = calibration.lidar_to_camera
    moved = to_camera @ pose @ np.linalg.inv(to_camera)
    return numbers(moved[:3] + 0.0) + "\n"  # no -0


def calibration_text(calibration: Calibration) -> str:
    """calib.txt: the projections of the four cameras, all the same one, and the LiDAR's pose."""
    rows = {**{f"P{i}": calibration.intrinsics for i in range(4)},
            "Tr": calibration.lidar_to_camera[:3]}
    return "".join(f"{name}: {numbers(matrix)}\n" for name, matrix in rows.items())

"""OpenPCDet's layout for custom data sets: points/NAME.npy, labels/NAME.txt and ImageSets/*.txt."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from lidar_perception.classes import find_class_name
from lidar_perception.data.cloud_files import load_points, make_cloud_scale_reader
from lidar_perception.data.frame import BOXES, Frame, Recording
from lidar_perception.data.kitti.folder import PERIOD_NS, START_NS
from lidar_perception.runs.files import read_text
from lidar_perception.types import CLASSES, MAX_NUMBER, GroundTruth, InputError
from lidar_perception.wire.messages import to_class_ids
from lidar_perception.wire.topics import LIDAR_FRAME

LINE_FORMAT = "x y z dx dy dz heading class"


def can_open(path: Path) -> bool:
    """Return True for a folder with points/*.npy and labels/ or ImageSets/."""
    return bool(_list_scans(path)) and any((path / name).is_dir() for name in ("labels", "ImageSets"))


def _list_scans(path: Path) -> list[Path]:
    return sorted(file for file in path.glob("points/*") if file.suffix.lower() == ".npy")


def open_layout(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """Open the clouds in order of their names; only file lists are read.

    The frames are not assumed to follow each other in time. The files in ImageSets/ can be used as
    split files.
    """
    files = _list_scans(path)
    scale = make_cloud_scale_reader(files)
    frames = []
    for i, file in enumerate(files):
        label, stamp = path / f"labels/{file.stem}.txt", START_NS + i * PERIOD_NS
        frames.append(
            Frame(
                file.stem,
                stamp,
                partial(load_points, file, stamp, LIDAR_FRAME, scale=scale),
                truth=partial(read_labels, label),
                index=i,
                points=file,
                files=(file, label),
                intensity_max=scale,
            )
        )
    scan_names = {frame.name for frame in frames}
    labels_without_scan = {
        label.stem: label for label in sorted(path.glob("labels/*.txt")) if label.stem not in scan_names
    }
    return Recording(
        path,
        "OpenPCDet custom data",
        frames,
        frozenset({BOXES} if any(path.glob("labels/*.txt")) else set()),
        tuple((name, f"{label} has no points/{name}.npy; add this file") for name, label in labels_without_scan.items())
        if scans
        else (),
        has_sensor_height=False,
        is_sequential=False,
    )


def read_labels(path: Path) -> GroundTruth | None:
    """Read the objects of a label file; None if it does not exist.

    Aliases of classes, such as Vehicle, are recognised. Unknown classes become Misc, with their
    name as class_name.
    """
    if not path.exists():
        return None
    boxes, names = [], []
    for i, line in enumerate(read_text(path, noun="the labels").splitlines(), 1):
        words = line.split()
        if not words:
            continue
        try:
            box = np.array(words[:7], float)
            if len(words) < 8 or not ((np.abs(box) <= MAX_NUMBER).all() and (box[3:6] > 0).all()):
                raise ValueError
        except ValueError:
            raise InputError(
                f"{path}:{i} is not a label ({LINE_FORMAT}, with positive sizes): {line[:200]!r}; correct or remove it"
            ) from None
        boxes.append(box)
        names.append(find_class_name(" ".join(words[7:])))
    ids = to_class_ids(names)
    misc = CLASSES.index("Misc")
    return GroundTruth.of(boxes, ids, [{"class_name": name} if i == misc else {} for name, i in zip(names, ids)])

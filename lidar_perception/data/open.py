"""Opening of recordings in any supported layout, and reading of the sensor height stored with them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from types import ModuleType

from lidar_perception.data import bag_frames, cloud_folder, openpcdet, semantickitti
from lidar_perception.data.cloud_files import SUFFIXES
from lidar_perception.data.frame import Recording
from lidar_perception.data.kitti import folder as kitti
from lidar_perception.data.kitti import kitti360, odometry, raw
from lidar_perception.data.nuscenes import folder as nuscenes
from lidar_perception.runs.files import read_text, write_text
from lidar_perception.runs.resumable_folder import INCOMPLETE_NAME, RECORD_NAME
from lidar_perception.types import InputError

# Modules with can_open(path) and open_layout(path, ...), and a description of the folder. The
# first one whose can_open returns True opens the path. To add a format, add a line here.
LAYOUTS = {
    bag_frames: "",
    semantickitti: "",
    odometry: "KITTI odometry or SemanticKITTI (sequences/00/)",
    kitti: "KITTI (velodyne/ or training/velodyne/)",
    kitti360: "KITTI-360 (data_3d_raw/)",
    raw: "KITTI raw drives (velodyne_points/data/)",
    openpcdet: "OpenPCDet's custom data (points/*.npy and labels/)",
    nuscenes: "nuScenes (v1.0-*/ and samples/)",
    cloud_folder: "",
}
PACKETS = ("sensor packets", "play it to the driver of the sensor and record its cloud topic in a bag")
LIVOX_VIEWER = (
    "Livox Viewer",
    "convert it to a bag with livox_ros_driver's lvx_to_rosbag.launch, or export PCD files in Livox Viewer",
)
# Suffix of an unsupported format -> its name and a converter.
CONVERTERS = {
    ".las": ("LAS", "convert it with PDAL: pdal translate IN.las OUT.pcd"),
    ".laz": ("LAZ", "convert it with PDAL: pdal translate IN.laz OUT.pcd"),
    ".e57": ("E57", "convert it with PDAL: pdal translate IN.e57 OUT.pcd"),
    ".tfrecord": ("Waymo", "convert it to KITTI with waymo_kitti_converter or mmdetection3d"),
    ".parquet": ("Waymo (version 2)", "convert it to KITTI with waymo_kitti_converter or mmdetection3d"),
    ".feather": (
        "Argoverse 2",
        "read the sweeps with av2 (av2.utils.io.read_lidar_sweep) and save x y z intensity with numpy.save",
    ),
    ".pcap": PACKETS,
    ".pcapng": PACKETS,
    ".lvx": LIVOX_VIEWER,
    ".lvx2": LIVOX_VIEWER,
    ".osf": ("Ouster OSF", "convert it with ouster-cli: ouster-cli source IN.osf save OUT.pcd"),
}
MAX_FILES = 10_000  # maximum number of files of a folder to inspect for these suffixes

# File with the sensor height of a folder in one of KITTI's layouts, which do not store it.
HEIGHT_FILE = "mount.json"  # written by `convert`
SIMULATION_KEY = "sensor_digest"  # key that exists only in a record of `simulate`
MAX_HEIGHT_FILE_BYTES = 1 << 16
MAX_DEPTH = 3  # maximum depth of an opened folder below the file, e.g. training/velodyne/0000
MAX_HEIGHT_M = 50.0


def open_recording(
    path: str | Path,
    *,
    split: str | Path | None = None,
    points: str = "",
    scans: bool = True,
    sensor_height: float | None = None,
) -> Recording:
    """Open a bag, a data set or point cloud files.

    Args:
        path: a bag (rosbag2 or ROS 1), a folder in one of LAYOUTS or one of its inner folders, a
            .pcd, .ply, .npy or .bin file, or a folder of such files. The path of a bag may end with
            a topic (see split_topic).
        split: file with names of frames or sequences, one per line; only these are read, in this
            order.
        points: topic of the clouds of a bag, if it is neither /points nor the only cloud topic.
        scans: False to include frames of KITTI that have labels but no scan.
        sensor_height: metres above the ground, to replace the height in the recording.

    Raises:
        InputError: the path cannot be opened.
    """
    path, topic = split_topic(path)
    points = points or topic
    if not path.exists():
        raise InputError(f"{path} does not exist; give a bag or the folder of a data set")
    if (layout := find_layout(path)) is None:
        raise InputError(f"{path} is not a recording in a supported format: {describe_formats()}")
    recording = layout.open_layout(path, points=points, scans=scans)
    if len(recording) == 0:
        raise InputError(f"{path} ({recording.layout}) has no frames; record or download it again")
    if sensor_height is None and layout is not bag_frames:
        sensor_height = read_height(path)
    if sensor_height is not None:
        frames = recording.frames
        recording = replace(
            recording,
            has_sensor_height=True,
            frames=(
                frames.with_sensor_height(sensor_height)
                if isinstance(frames, bag_frames.BagFrames)
                else [replace(frame, sensor_height=sensor_height) for frame in frames]
            ),
        )
    recording = replace(
        recording,
        reopen=partial(open_recording, path, split=split, points=points, scans=scans, sensor_height=sensor_height),
    )
    return recording if split is None else _select_split(recording, Path(split))


def describe_formats() -> str:
    """Return the list of supported formats, for error messages."""
    *folders, last = filter(None, LAYOUTS.values())
    return f"expected a rosbag2 bag, or the folder of {', '.join(folders)} or {last}, or {', '.join(SUFFIXES)} files"


def find_layout(path: Path) -> ModuleType | None:
    """Return the module in LAYOUTS that can open a path, or None.

    Raises InputError, which names a converter, for an unsupported format in CONVERTERS.
    """
    if not (path.is_file() and path.suffix.lower() in CONVERTERS):
        for layout in LAYOUTS:
            if layout.can_open(path):
                return layout
    for file in [path] if path.is_file() else islice(path.rglob("*"), MAX_FILES):
        if file.suffix.lower() in CONVERTERS:
            name, remedy = CONVERTERS[file.suffix.lower()]
            raise InputError(f"{path} is in the format {name} ({file.name}), which is not supported; {remedy}")
    return None


def split_topic(path: str | Path) -> tuple[Path, str]:
    """Split a path such as drive.bag:/front/points into the path of the bag and the topic or ""."""
    name, colon, topic = str(path).rpartition(":/")
    return (Path(name), f"/{topic}") if colon and not Path(path).exists() else (Path(path), "")


def _select_split(recording: Recording, split: Path) -> Recording:
    """Return a recording of the frames and sequences listed in a split file, without duplicates."""
    names = read_text(split, noun="the split").split()
    sequences: dict[str, list[str]] = {}
    frames: dict[str, None] = {}
    for frame in recording:
        frames[frame.name] = None
        sequences.setdefault(frame.sequence, []).append(frame.name)
    first = next(iter(frames), "none")
    if not names:
        raise InputError(f"{split} is empty; write the name of a frame or sequence on each line, such as {first}")
    selected_names: dict[str, None] = {}
    unknown_names: list[str] = []
    for name in names:
        matches: Sequence[str] = [name] if name in frames else sequences.get(name, ())
        selected_names.update(dict.fromkeys(matches))
        unknown_names += [] if matches else [name]
    if unknown_names:
        raise InputError(
            f"{split} lists names that are not in {recording.path}, such as {unknown_names[0]} "
            f"({len(unknown_names)} in all); names there look like {first}"
        )
    return recording.select(list(selected_names))


def write_height(folder: Path, height: float) -> None:
    """Store the sensor height above the ground, in metres, in a folder."""
    write_text(folder / HEIGHT_FILE, json.dumps({"height": height}))


def read_height(path: Path) -> float | None:
    """Return the sensor height in metres that `convert` or `simulate` stored, or None.

    Searches the folder and its parents up to MAX_DEPTH levels.
    """
    for folder in (path, *path.absolute().parents[:MAX_DEPTH]):
        for name in (HEIGHT_FILE, RECORD_NAME, INCOMPLETE_NAME):
            with suppress(InputError, ValueError, RecursionError):
                content = json.loads(read_text(folder / name, MAX_HEIGHT_FILE_BYTES))
                if isinstance(content, dict) and (name == HEIGHT_FILE or SIMULATION_KEY in content):
                    height = content.get("height")
                    if isinstance(height, (int, float)) and 0 < height <= MAX_HEIGHT_M:
                        return float(height)
    return None

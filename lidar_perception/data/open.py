"""One opener for every recording: it looks at what lies there, so that nobody need say it."""

from __future__ import annotations

from collections.abc import Sequence
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
from lidar_perception.data.mounting import height_of
from lidar_perception.data.nuscenes import folder as nuscenes
from lidar_perception.runs.files import read_text
from lidar_perception.types import InputError

# Modules with recognises(path) and open_recording(path, ...), the first that recognises a path
# opens it; and how such a folder looks. A new format is one line here.
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
PACKETS = ("sensor packets", "play it to the driver of the sensor and record its cloud topic in a "
           "bag")
LIVOX_VIEWER = ("Livox Viewer", "make a bag of it with livox_ros_driver's lvx_to_rosbag.launch, or "
                "export PCD files in Livox Viewer")
# Suffixes of other formats, and what makes one of the above of them.
CONVERTERS = {
    ".las": ("LAS", "convert it with PDAL: pdal translate IN.las OUT.pcd"),
    ".laz": ("LAZ", "convert it with PDAL: pdal translate IN.laz OUT.pcd"),
    ".e57": ("E57", "convert it with PDAL: pdal translate IN.e57 OUT.pcd"),
    ".tfrecord": ("Waymo", "convert it to KITTI with waymo_kitti_converter or mmdetection3d"),
    ".parquet": ("Waymo (version 2)", "convert it to KITTI with waymo_kitti_converter or "
                 "mmdetection3d"),
    ".feather": ("Argoverse 2", "read the sweeps with av2 (av2.utils.io.read_lidar_sweep) and save "
                 "x y z intensity with numpy.save"),
    ".pcap": PACKETS, ".pcapng": PACKETS,
    ".lvx": LIVOX_VIEWER, ".lvx2": LIVOX_VIEWER,
    ".osf": ("Ouster OSF", "convert it with ouster-cli: ouster-cli source IN.osf save OUT.pcd"),
}
MAX_FILES = 10_000  # of a folder that are looked at for these


def open_recording(path: str | Path, *, split: str | Path | None = None, points: str = "",
                   scans: bool = True, sensor_height: float | None = None) -> Recording:
    """Open the recording at a path: a bag (rosbag2 or ROS 1), a folder in one of LAYOUTS or one of
    its inner folders, or a .pcd, .ply, .npy or .bin file or a folder of them.

    split: file that names frames or whole sequences, one a line; only these, in its order. points:
    topic of the clouds of a bag, where it is neither /points nor the only one; a path may name it,
    too, see with_topic. Without scans, labels are enough to make a frame of KITTI. sensor_height:
    metres above the ground, instead of what the recording says. InputError says what is missing,
    and what can be opened.
    """
    path, named = with_topic(path)
    points = points or named
    if not path.exists():
        raise InputError(f"there is no {path}; give a bag or the folder of a data set")
    if (layout := layout_of(path)) is None:
        raise InputError(f"{path} is no recording that can be read: {expected()}")
    recording = layout.open_recording(path, points=points, scans=scans)
    if len(recording) == 0:
        raise InputError(f"{path} ({recording.layout}) has no frame; record or download it again")
    if sensor_height is None and layout is not bag_frames:
        sensor_height = height_of(path)
    if sensor_height is not None:
        frames = recording.frames
        recording = replace(recording, mounted=True, frames=(
            frames.mounted_at(sensor_height) if isinstance(frames, bag_frames.BagFrames)
            else [replace(frame, sensor_height=sensor_height) for frame in frames]))
    recording = replace(recording, reopen=partial(
        open_recording, path, split=split, points=points, scans=scans,
        sensor_height=sensor_height))
    return recording if split is None else _of_split(recording, Path(split))


def expected() -> str:
    """Return the list of what can be opened, for messages."""
    *folders, last = filter(None, LAYOUTS.values())
    return (f"expected a rosbag2 bag, or the folder of {', '.join(folders)} or {last}, or "
            f"{', '.join(SUFFIXES)} files")


def layout_of(path: Path) -> ModuleType | None:
    """Return the module of LAYOUTS that recognises a path; None where none does. InputError with a
    converter for a known format that is not read."""
    if not (path.is_file() and path.suffix.lower() in CONVERTERS):
        for layout in LAYOUTS:
            if layout.recognises(path):
                return layout
    for file in [path] if path.is_file() else islice(path.rglob("*"), MAX_FILES):
        if file.suffix.lower() in CONVERTERS:
            name, remedy = CONVERTERS[file.suffix.lower()]
            raise InputError(f"{path} is in the format {name} ({file.name}), which is not read; "
                             f"{remedy}")
    return None


def with_topic(path: str | Path) -> tuple[Path, str]:
    """The path of a bag, and the topic that is named behind it, as in drive.bag:/front/points; ""
    where there is none."""
    name, colon, topic = str(path).rpartition(":/")
    return (Path(name), f"/{topic}") if colon and not Path(path).exists() else (Path(path), "")


def _of_split(recording: Recording, split: Path) -> Recording:
    """The frames that a file names, by themselves or by their sequence, each once."""
    names = read_text(split, what="the split").split()
    sequences: dict[str, list[str]] = {}
    frames: dict[str, None] = {}
    for frame in recording:
        frames[frame.name] = None
        sequences.setdefault(frame.sequence, []).append(frame.name)
    first = next(iter(frames), "none")
    if not names:
        raise InputError(f"{split} names no frame; it needs one a line, such as {first}")
    chosen: dict[str, None] = {}
    unknown: list[str] = []
    for name in names:
        found: Sequence[str] = [name] if name in frames else sequences.get(name, ())
        chosen.update(dict.fromkeys(found))
        unknown += [] if found else [name]
    if unknown:
        raise InputError(f"{split} names {unknown[0]} ({len(unknown)} such), which is not in "
                         f"{recording.path}; its first frame is {first}")
    return recording.chosen(list(chosen))

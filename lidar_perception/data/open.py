"""One opener for every recording: it looks at what lies there, so that nobody need say it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from lidar_perception.data import bag_frames, cloud_files, semantickitti
from lidar_perception.data.frame import Recording
from lidar_perception.data.kitti import folder as kitti
from lidar_perception.data.mounting import height_of
from lidar_perception.data.nuscenes import folder as nuscenes
from lidar_perception.runs.files import regular
from lidar_perception.types import InputError

# Each has recognises(path) and open_recording(path, ...); a new data set is one line here.
LAYOUTS = (bag_frames, nuscenes, semantickitti, kitti, cloud_files)


def open_recording(path: str | Path, *, split: str | Path | None = None, points: str = "",
                   scans: bool = True, sensor_height: float | None = None) -> Recording:
    """The frames at a path: a rosbag2 bag, or a folder of KITTI (object, tracking, raw, or what
    `simulate` wrote), nuScenes or SemanticKITTI, or one of its inner folders, or .pcd or .bin
    files.

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
    layout = next((layout for layout in LAYOUTS if layout.recognises(path)), None)
    if layout is None:
        raise InputError(f"{path} is no recording that can be read: expected a rosbag2 bag, or "
                         "the folder of KITTI (velodyne/ or training/velodyne/, or raw drives), "
                         "nuScenes (v1.0-*/ and samples/) or SemanticKITTI (sequences/00/), or "
                         ".pcd or .bin files")
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


def with_topic(path: str | Path) -> tuple[Path, str]:
    """The path of a bag, and the topic that is named behind it, as in drive.bag:/front/points; ""
    where there is none."""
    name, colon, topic = str(path).rpartition(":/")
    return (Path(name), f"/{topic}") if colon and not Path(path).exists() else (Path(path), "")


def _of_split(recording: Recording, split: Path) -> Recording:
    """The frames that a file names, by themselves or by their sequence, each once."""
    try:
        names = regular(split).read_text().split()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the split {split}: {error}") from None
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

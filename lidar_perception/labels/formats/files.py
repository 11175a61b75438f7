"""Functions that several label formats share: files of frames and drives, track names, and JSON."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lidar_perception.data.frame import Frame
from lidar_perception.labels.drive_labels import NO_TRACK, FrameLabels
from lidar_perception.runs.files import check_unused, read_text, write_folder, write_text
from lidar_perception.types import InputError

MAX_BYTES = 2**30  # maximum size of a label file
CONFLICTS_KEY = "kept"  # key of extra fields whose names have another meaning in the format


def group_by_sequence(frames: Sequence[Frame]) -> dict[str, list[int]]:
    """Return the positions in `frames` of the frames of each sequence, in order."""
    positions: dict[str, list[int]] = {}
    for i, frame in enumerate(frames):
        positions.setdefault(frame.sequence, []).append(i)
    return positions


def list_drive_files(path: Path, frames: Sequence[Frame], suffix: str) -> dict[str, Path]:
    """Return the label file of each drive.

    The file is `path` if this has the suffix, otherwise path/DRIVE.suffix. A drive without a name
    is called 0000.

    Raises:
        InputError: `path` is a single file, but there are several drives.
    """
    names = list(group_by_sequence(frames))
    if path.suffix == suffix:
        if len(names) != 1:
            raise InputError(
                f"{path} is a single file, but the frames belong to {len(names)} drives, "
                f"such as {names[0]!r}; give a folder, or choose a drive with --split"
            )
        return {names[0]: path}
    return {name: path / f"{name or '0000'}{suffix}" for name in names}


def find_drive_files(path: Path, frames: Sequence[Frame], suffix: str) -> dict[str, Path]:
    """Return the existing files of list_drive_files, and `path` if it is a file.

    Raises the errors of check_label_files.
    """
    files = list_drive_files(path, frames, suffix)
    if path not in files.values():
        check_label_files(path, list(files.values()), suffix)
    return {drive: file for drive, file in files.items() if file == path or file.exists()}


def write_drives(
    out: Path, frames: Sequence[Frame], suffix: str, force: bool, write: Callable[[Path, str, list[int]], None]
) -> None:
    """Write one file per drive with write(file, drive, positions of its frames).

    Args:
        out: File of the only drive if it has the suffix; otherwise a folder, which is created after
            all files have been written.
        frames: Frames of all drives.
        suffix: Suffix of a label file.
        force: Replace existing files.
        write: Function that writes the file of one drive.
    """
    drives = group_by_sequence(frames)
    if out.suffix == suffix:
        ((drive, file),) = list_drive_files(out, frames, suffix).items()
        check_unused(out, force)
        write(file, drive, drives[drive])
        return
    with write_folder(out, force) as folder:
        for drive, file in list_drive_files(folder, frames, suffix).items():
            write(file, drive, drives[drive])


def list_frame_files(folder: Path, frames: Sequence[Frame], suffix: str) -> list[Path]:
    """Return the label file FRAME.suffix of each frame.

    With several drives, each drive has its own folder.
    """
    has_drives = len(group_by_sequence(frames)) > 1
    return [folder / f"{frame.name if has_drives else frame.name.rpartition('/')[2]}{suffix}" for frame in frames]


def check_label_files(folder: Path, expected: Sequence[Path], suffix: str, ignored: Sequence[str] = ()) -> None:
    """Check that a folder has label files, and no label files of other frames.

    Args:
        expected: Label files of the frames.
        suffix: Suffix of a label file.
        ignored: Names of other files that are allowed.

    Raises:
        InputError: The folder does not exist, has no label files, or has label files of other
            frames.
    """
    if not folder.is_dir():
        raise InputError(f"the folder {folder} does not exist; give the folder of the label files")
    names = {str(path.relative_to(folder)) for path in expected}
    existing = {
        str(path.relative_to(folder))
        for path in folder.rglob(f"*{suffix}")
        if path.name not in ignored and not path.name.startswith(".")
    }
    example = min(names, default="none")
    if unknown_names := sorted(existing - names):
        raise InputError(
            f"{folder / unknown_names[0]} does not belong to a frame of the drive "
            f"({len(unknown_names)} such files; expected names such as {example}); "
            "give the drive that was labelled, or move these files away"
        )
    if not existing:
        raise InputError(f"{folder} has no label files (*{suffix}); expected names such as {example}")


def merge_extra(extra: dict[str, Any], own_names: Collection[str]) -> dict[str, Any]:
    """Return the extra fields of a box as fields of a format.

    Fields with a name in `own_names`, which the format uses itself, are stored under CONFLICTS_KEY.
    """
    conflicts = {key: value for key, value in extra.items() if key in own_names or key == CONFLICTS_KEY}
    return {
        **{key: value for key, value in extra.items() if key not in conflicts},
        **({CONFLICTS_KEY: conflicts} if conflicts else {}),
    }


def extract_extra(item: dict[str, Any], own_names: Collection[str]) -> dict[str, Any]:
    """Return the extra fields of a box, the inverse of merge_extra."""
    conflicts = item.get(CONFLICTS_KEY)
    extra = {key: value for key, value in item.items() if key not in own_names}
    return {**extra, **extra.pop(CONFLICTS_KEY)} if isinstance(conflicts, dict) else extra


def assign_track_ids(names: Iterable[str]) -> dict[str, int]:
    """Return a track id for each name: its number if the name is a number, otherwise a new one."""
    unique_names = sorted(set(names))
    ids = {name: int(name) for name in unique_names if is_track_number(name)}
    new_ids = itertools.count(max([0, *ids.values()]) + 1)
    return ids | {name: next(new_ids) for name in unique_names if name not in ids}


def collect_track_names(frames: Iterable[FrameLabels], key: str) -> dict[int, str]:
    """Return the original name of each track, which was stored in extra[key] when the file was read.

    A name is used for only one track, so that the parts of a split track have different names.
    """
    names: dict[int, str] = {}
    used_names = set()
    for labels in frames:
        for track, extra in zip(labels.track_ids.tolist(), labels.extra):
            name = extra.get(key)
            if track != NO_TRACK and track not in names and name is not None and str(name) not in used_names:
                names[track] = str(name)
                used_names.add(str(name))
    return names


def is_track_number(name: str) -> bool:
    """Return True if the name of a track is a decimal integer without leading zeros."""
    return name.isascii() and name.isdigit() and len(name) < 19 and name == str(int(name))


def read_json(path: Path) -> Any:
    """Read a JSON file. Raise InputError if it cannot be read or is not valid JSON."""
    text = read_text(path, MAX_BYTES)
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(
            f"{path}:{error.lineno} is not valid JSON: {error.msg} at column {error.colno}; export the file again"
        ) from None
    except RecursionError:
        raise InputError(f"{path} is nested too deeply; export the file again") from None


def write_json(path: Path, content: Any, indent: int | None = None) -> None:
    """Write a standard JSON file; numbers that are not finite become null."""
    write_text(path, json.dumps(replace_non_finite(content), indent=indent, allow_nan=False))


def replace_non_finite(value: Any) -> Any:
    """Replace numbers in a JSON value that are not finite by null."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): replace_non_finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [replace_non_finite(item) for item in value]
    return value


@contextmanager
def report_format_errors(source: object) -> Iterator[None]:
    """Convert errors in the block to InputErrors that start with `source`, the name of a file.

    Use it to parse files whose values may be of any type.
    """
    try:
        yield
    except InputError:
        raise
    except KeyError as error:
        raise InputError(f"{source} has no {error}; export the file again") from None
    except (TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise InputError(f"{source} is malformed ({error}); export the file again") from None

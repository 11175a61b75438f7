"""Which file of a folder of labels belongs to which frame or drive, and JSON files."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

from lidar_perception.data.frame import Frame
from lidar_perception.labels.drive_labels import NO_TRACK, FrameLabels
from lidar_perception.runs.files import check_unused, read_text, write_folder, write_text
from lidar_perception.types import InputError

MAX_BYTES = 2**30  # of a file of labels
KEPT = "kept"


def sequences_of(frames: Sequence[Frame]) -> dict[str, list[int]]:
    """Positions in frames by the drive that they belong to, in order."""
    found: dict[str, list[int]] = {}
    for i, frame in enumerate(frames):
        found.setdefault(frame.sequence, []).append(i)
    return found


def drive_files(path: Path, frames: Sequence[Frame], suffix: str) -> dict[str, Path]:
    """The file of each drive: `path` itself if it ends like one, else path/DRIVE.suffix, with 0000
    for a drive without a name. InputError for one file and several drives."""
    names = list(sequences_of(frames))
    if path.suffix == suffix:
        if len(names) != 1:
            raise InputError(f"{path} is one file, and the frames are of {len(names)} drives, "
                             f"such as {names[0]!r}; give a folder, or choose a drive with --split")
        return {names[0]: path}
    return {name: path / f"{name or '0000'}{suffix}" for name in names}


def known_drive_files(path: Path, frames: Sequence[Frame], suffix: str) -> dict[str, Path]:
    """Of drive_files those that there are, and `path` itself. InputError as of check_all_known for
    a folder."""
    files = drive_files(path, frames, suffix)
    if path not in files.values():
        check_all_known(path, list(files.values()), suffix)
    return {drive: file for drive, file in files.items() if file == path or file.exists()}


def write_drives(out: Path, frames: Sequence[Frame], suffix: str, force: bool,
                 write: Callable[[Path, str, list[int]], None]) -> None:
    """Call write(file, drive, positions in frames) for each drive: `out` is the file of the only
    one if it ends like one, else a folder that appears when all of them are complete."""
    drives = sequences_of(frames)
    if out.suffix == suffix:
        ((drive, file),) = drive_files(out, frames, suffix).items()
        check_unused(out, force)
        write(file, drive, drives[drive])
        return
    with write_folder(out, force) as folder:
        for drive, file in drive_files(folder, frames, suffix).items():
            write(file, drive, drives[drive])


def frame_files(folder: Path, frames: Sequence[Frame], suffix: str) -> list[Path]:
    """The file of each frame: named as the frame, in a folder for each drive if there are
    several."""
    several = len(sequences_of(frames)) > 1
    return [folder / f"{frame.name if several else frame.name.rpartition('/')[2]}{suffix}"
            for frame in frames]


def check_all_known(folder: Path, known: Sequence[Path], suffix: str,
                    but: Sequence[str] = ()) -> None:
    """InputError if a folder has no label file of any of the known, or one that is none of them,
    except for those of the names `but`."""
    if not folder.is_dir():
        raise InputError(f"there is no folder {folder}; give the folder of the label files")
    names = {str(path.relative_to(folder)) for path in known}
    there = {str(path.relative_to(folder)) for path in folder.rglob(f"*{suffix}")
             if path.name not in but and not path.name.startswith(".")}
    example = min(names, default="none")
    if strange := sorted(there - names):
        raise InputError(f"{folder / strange[0]} is of no frame of the drive ({len(strange)} such "
                         f"files; those of the drive are named like {example}); give the drive "
                         "that was labelled, or move these files away")
    if not there:
        raise InputError(f"{folder} has no label file (*{suffix}); those of this drive would be "
                         f"named like {example}")


def beside(extra: dict[str, Any], own: Collection[str]) -> dict[str, Any]:
    """What else is known of a box as further fields of a format; under KEPT what would take the
    place of one of its own."""
    taken = {key: value for key, value in extra.items() if key in own or key == KEPT}
    return {**{key: value for key, value in extra.items() if key not in taken},
            **({KEPT: taken} if taken else {})}


def extra_of(item: dict[str, Any], own: Collection[str]) -> dict[str, Any]:
    """The inverse of beside()."""
    kept = item.get(KEPT)
    rest = {key: value for key, value in item.items() if key not in own}
    return {**rest, **rest.pop(KEPT)} if isinstance(kept, dict) else rest


def track_numbers(names: Iterable[str]) -> dict[str, int]:
    """A track id for each name: its number where it is one, else one behind all of these."""
    known = sorted(set(names))
    found = {name: int(name) for name in known if is_number(name)}
    following = itertools.count(max([0, *found.values()]) + 1)
    return found | {name: next(following) for name in known if name not in found}


def track_names(frames: Iterable[FrameLabels], key: str) -> dict[int, str]:
    """The names that tracks had in a file, which are under `key` in extra: each for one track, so
    that the parts of a track that was split are two."""
    found: dict[int, str] = {}
    taken = set()
    for each in frames:
        for track, extra in zip(each.track_ids.tolist(), each.extra):
            name = extra.get(key)
            if (track != NO_TRACK and track not in found and name is not None
                    and str(name) not in taken):
                found[track] = str(name)
                taken.add(str(name))
    return found


def is_number(name: str) -> bool:
    """Whether a track id is written as it would be as a number."""
    return name.isascii() and name.isdigit() and len(name) < 19 and name == str(int(name))


def read_json(path: Path) -> Any:
    """What a JSON file holds. InputError with the line where it is broken."""
    text = read_text(path, MAX_BYTES)
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"{path}:{error.lineno} is no JSON: {error.msg} at column {error.colno}; "
                         "write the file again") from None
    except RecursionError:
        raise InputError(f"{path} is nested too deep; write the file again") from None


def write_json(path: Path, content: Any, indent: int | None = None) -> None:
    """Write a JSON file as every reader takes it: null instead of numbers that are not finite."""
    write_text(path, json.dumps(finite(content), indent=indent, allow_nan=False))


def finite(value: Any) -> Any:
    """A JSON value with null instead of numbers that are not finite."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): finite(item) for key, item in value.items()}
    return [finite(item) for item in value] if isinstance(value, list | tuple) else value


def in_file(where: str, read: Callable[[], Any]) -> Any:
    """What read() gives of a file whose values may be of any kind. InputError names `where`, and
    the key that is missing."""
    try:
        return read()
    except InputError:
        raise
    except KeyError as error:
        raise InputError(f"{where} has no {error}; write the file again") from None
    except (TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise InputError(f"{where} cannot be read ({error}); write the file again") from None

"""A folder that is written frame by frame, marked until it is complete, and resumed after a stop.

Until it is complete, it has INCOMPLETE, a JSON file of its settings, and .parts with one file per
finished frame: that frame's share of the files that belong to many frames, such as the label file
of a sequence. At the end the shares are joined, INCOMPLETE is renamed to dataset.json, which
records the settings, and .parts is removed.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from lidar_perception.runs.files import refuse_other_files, remove_temporaries, write_bytes, write_text
from lidar_perception.runs.resuming import find_differences, lock_folder
from lidar_perception.types import InputError

INCOMPLETE_NAME, PARTS_NAME, RECORD_NAME = "INCOMPLETE", ".parts", "dataset.json"


def is_finished(folder: Path) -> bool:
    """Return True if the folder is a complete data set written by this package."""
    return (folder / RECORD_NAME).is_file() and not (folder / INCOMPLETE_NAME).exists()


@contextmanager
def make_resumable_folder(
    folder: Path, settings: dict, names: Iterable[str], *, resume: bool = False, force: bool = False
) -> Iterator[list[int]]:
    """Yield the numbers of the frames that are still to be written.

    The caller ends each frame with finish_frame(). After the block, the folder is complete; after
    an exception in it, the folder can be resumed.

    Args:
        settings: the settings of the data set; settings["frames"] is the number of frames.
        names: the names of files and folders in such a folder, which force replaces.

    Raises:
        InputError: if the folder exists and neither resume nor force is given; with resume, if it
            was begun with other settings; with force, if it is not a data set of this package, or
            has other files.
    """
    with lock_folder(folder):
        _begin(folder, settings, names, resume, force)
        if not is_finished(folder):
            for path, _, _ in os.walk(folder):
                remove_temporaries(Path(path), "*")
            yield [i for i in range(settings["frames"]) if not _part_path(folder, i).exists()]
            _join(folder, settings["frames"])
            (folder / INCOMPLETE_NAME).replace(folder / RECORD_NAME)
        else:
            yield []
        shutil.rmtree(folder / PARTS_NAME, ignore_errors=True)


def finish_frame(folder: Path, number: int, shares: dict[str, str]) -> None:
    """Mark a frame as finished, after all its files are written.

    shares: path in the folder -> text that this frame adds to that file, in the order of frames.
    """
    write_text(_part_path(folder, number), json.dumps(shares))


def _part_path(folder: Path, number: int) -> Path:
    return folder / PARTS_NAME / f"{number:06}.json"


def _begin(folder: Path, settings: dict, names: Iterable[str], resume: bool, force: bool) -> None:
    """Check the folder, and clear it unless it is resumed."""
    exists = any(folder.iterdir())
    ours = (folder / INCOMPLETE_NAME).is_file() or (folder / RECORD_NAME).is_file()
    if exists and not (resume or force):
        raise InputError(f"{folder} exists already; give another name" + (", --resume or --force" if ours else ""))
    if exists and not ours:
        raise InputError(f"{folder} is not a simulated data set, so it is left as it is; give another name")
    if exists and resume:
        _check_settings(folder, settings)
        return
    refuse_other_files(folder, (*names, INCOMPLETE_NAME, RECORD_NAME, PARTS_NAME))
    write_text(folder / INCOMPLETE_NAME, "{}")  # if interrupted during removal, only force accepts the folder
    for old in folder.iterdir():
        if old.is_dir() and not old.is_symlink():
            shutil.rmtree(old)
        elif old.name != INCOMPLETE_NAME:
            old.unlink()
    write_text(folder / INCOMPLETE_NAME, json.dumps(settings, indent=1))


def _check_settings(folder: Path, settings: dict) -> None:
    path = folder / (RECORD_NAME if is_finished(folder) else INCOMPLETE_NAME)
    try:
        before = json.loads(path.read_text())
        different = find_differences(before, {k: v for k, v in settings.items() if k != "command"})
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(f"cannot read {path}: {error}; --force starts again") from None
    if not before:
        raise InputError(f"{folder} was stopped while --force removed what was there; start again with --force")
    if different:
        raise InputError(
            f"{folder} was begun with {'; '.join(different)}; resume it with the same "
            "arguments, or start again with --force"
        )


def _join(folder: Path, frames: int) -> None:
    """Write the files that belong to many frames from the shares."""
    whole: dict[str, list[str]] = {}
    for i in range(frames):
        try:
            shares = json.loads(_part_path(folder, i).read_text())
        except (OSError, ValueError) as error:
            raise InputError(f"cannot read {_part_path(folder, i)}: {error}; remove it and --resume") from None
        for name, text in shares.items():
            whole.setdefault(name, []).append(text)
    for name, texts in whole.items():
        write_bytes(folder / name, "".join(texts).encode())

"""Data set folder that is written frame by frame and can be resumed after an interruption.

While it is incomplete, the folder has a JSON file INCOMPLETE with the settings, and a folder .parts
with one file per finished frame. Such a file contains what the frame adds to files of many frames,
such as the label file of a sequence. At the end these parts are joined, INCOMPLETE is renamed to
dataset.json, and .parts is removed.
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
    """Yield the numbers of the frames that remain to be written.

    The caller must call finish_frame() after each frame. After the block the folder is complete;
    after an exception in the block it can be resumed.

    Args:
        settings: Settings of the data set; settings["frames"] is the number of frames.
        names: Names of the files and folders of the data set, which force replaces.
        resume: Continue an interrupted run.
        force: Replace an existing data set.

    Raises:
        InputError: The folder exists without resume or force; or, with resume, it was written with
            different settings; or, with force, it is not a data set of this package or has other
            files.
    """
    with lock_folder(folder):
        _prepare_folder(folder, settings, names, resume, force)
        if not is_finished(folder):
            for path, _, _ in os.walk(folder):
                remove_temporaries(Path(path), "*")
            yield [i for i in range(settings["frames"]) if not _part_path(folder, i).exists()]
            _join_parts(folder, settings["frames"])
            (folder / INCOMPLETE_NAME).replace(folder / RECORD_NAME)
        else:
            yield []
        shutil.rmtree(folder / PARTS_NAME, ignore_errors=True)


def finish_frame(folder: Path, number: int, parts: dict[str, str]) -> None:
    """Mark a frame as finished; call this after all its files are written.

    Args:
        number: Number of the frame.
        parts: Text that the frame adds to files of many frames, by path in the folder. The parts
            are joined in the order of the frames.
    """
    write_text(_part_path(folder, number), json.dumps(parts))


def _part_path(folder: Path, number: int) -> Path:
    return folder / PARTS_NAME / f"{number:06}.json"


def _prepare_folder(folder: Path, settings: dict, names: Iterable[str], resume: bool, force: bool) -> None:
    """Check the folder, and clear it unless it is resumed."""
    exists = any(folder.iterdir())
    is_own = (folder / INCOMPLETE_NAME).is_file() or (folder / RECORD_NAME).is_file()
    if exists and not (resume or force):
        raise InputError(f"{folder} already exists; give another name" + (", --resume or --force" if is_own else ""))
    if exists and not is_own:
        raise InputError(f"{folder} is not a simulated data set, so it is not overwritten; give another name")
    if exists and resume:
        _check_settings(folder, settings)
        return
    refuse_other_files(folder, (*names, INCOMPLETE_NAME, RECORD_NAME, PARTS_NAME))
    # If the removal is interrupted, the empty settings make sure that only force accepts the folder.
    write_text(folder / INCOMPLETE_NAME, "{}")
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != INCOMPLETE_NAME:
            path.unlink()
    write_text(folder / INCOMPLETE_NAME, json.dumps(settings, indent=1))


def _check_settings(folder: Path, settings: dict) -> None:
    path = folder / (RECORD_NAME if is_finished(folder) else INCOMPLETE_NAME)
    try:
        old_settings = json.loads(path.read_text())
        differences = find_differences(old_settings, {k: v for k, v in settings.items() if k != "command"})
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(f"cannot read {path}: {error}; use --force to start again") from None
    if not old_settings:
        raise InputError(f"{folder} is incomplete because --force was interrupted; start again with --force")
    if differences:
        raise InputError(
            f"{folder} was written with other settings ({'; '.join(differences)}); resume it with the same "
            "arguments, or use --force to start again"
        )


def _join_parts(folder: Path, frames: int) -> None:
    """Join the parts of all frames, and write the files that belong to many frames."""
    texts_by_name: dict[str, list[str]] = {}
    for i in range(frames):
        try:
            parts = json.loads(_part_path(folder, i).read_text())
        except (OSError, ValueError) as error:
            raise InputError(
                f"cannot read {_part_path(folder, i)}: {error}; remove it and run again with --resume"
            ) from None
        for name, text in parts.items():
            texts_by_name.setdefault(name, []).append(text)
    for name, texts in texts_by_name.items():
        write_bytes(folder / name, "".join(texts).encode())

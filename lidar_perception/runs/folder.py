"""A folder that is made frame by frame: marked until it is complete, and resumed after a stop.

While it is made it holds INCOMPLETE, a JSON file of what was asked, and .parts with one file for
each finished frame: that frame's share of the files that belong to many frames, such as the label
file of a sequence. At the end the shares are joined, INCOMPLETE becomes dataset.json, which says
how the folder was made, and .parts goes.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from lidar_perception.runs.files import refuse_others, remove_temporaries, write_bytes, write_text
from lidar_perception.runs.resuming import differences, locked
from lidar_perception.types import InputError

MARK, PARTS, RECORD = "INCOMPLETE", ".parts", "dataset.json"


def is_finished(folder: Path) -> bool:
    """Whether the folder is a whole data set of ours."""
    return (folder / RECORD).is_file() and not (folder / MARK).exists()


@contextmanager
def unfinished(folder: Path, asked: dict, made: Iterable[str], *, resume: bool = False,
               force: bool = False) -> Iterator[list[int]]:
    """The numbers of the frames 0 .. asked["frames"] - 1 that are to be made, each of which ends
    with finish_frame(). After the block the folder is whole; after an exception in it the folder
    can be resumed. made: the names that any such folder has in it, which force replaces.

    InputError if the folder is there already, without resume or force; to resume, if it was begun
    with something else asked for; to force, if it is no data set of ours, or has other files.
    """
    with locked(folder):
        _begin(folder, asked, made, resume, force)
        if not is_finished(folder):
            for path, _, _ in os.walk(folder):
                remove_temporaries(Path(path), "*")
            yield [i for i in range(asked["frames"]) if not _part(folder, i).exists()]
            _join(folder, asked["frames"])
            (folder / MARK).replace(folder / RECORD)
        else:
            yield []
        shutil.rmtree(folder / PARTS, ignore_errors=True)


def finish_frame(folder: Path, number: int, shares: dict[str, str]) -> None:
    """Mark a frame as made; its files are all written. shares: path in the folder -> what this
    frame adds to that file, in the order of the frames."""
    write_text(_part(folder, number), json.dumps(shares))


def _part(folder: Path, number: int) -> Path:
    return folder / PARTS / f"{number:06}.json"


def _begin(folder: Path, asked: dict, made: Iterable[str], resume: bool, force: bool) -> None:
    """Look at what is there, and begin anew unless that is to be resumed."""
    there = any(folder.iterdir())
    ours = (folder / MARK).is_file() or (folder / RECORD).is_file()
    if there and not (resume or force):
        raise InputError(f"{folder} exists already; give another name"
                         + (", --resume or --force" if ours else ""))
    if there and not ours:
        raise InputError(f"{folder} is no simulated data set, so it is left as it is; give another "
                         "name")
    if there and resume:
        _compare(folder, asked)
        return
    refuse_others(folder, (*made, MARK, RECORD, PARTS))
    write_text(folder / MARK, "{}")  # a stop while files are removed leaves what only force takes
    for old in folder.iterdir():
        if old.is_dir() and not old.is_symlink():
            shutil.rmtree(old)
        elif old.name != MARK:
            old.unlink()
    write_text(folder / MARK, json.dumps(asked, indent=1))


def _compare(folder: Path, asked: dict) -> None:
    path = folder / (RECORD if is_finished(folder) else MARK)
    try:
        before = json.loads(path.read_text())
        different = differences(before, {k: v for k, v in asked.items() if k != "command"})
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(f"cannot read {path}: {error}; --force starts again") from None
    if not before:
        raise InputError(f"{folder} was stopped while --force removed what was there; start again "
                         "with --force")
    if different:
        raise InputError(f"{folder} was begun with {'; '.join(different)}; resume it with the same "
                         "arguments, or start again with --force")


def _join(folder: Path, frames: int) -> None:
    """Write the files that belong to many frames."""
    whole: dict[str, list[str]] = {}
    for i in range(frames):
        try:
            shares = json.loads(_part(folder, i).read_text())
        except (OSError, ValueError) as error:
            raise InputError(f"cannot read {_part(folder, i)}: {error}; remove it and "
                             "--resume") from None
        for name, text in shares.items():
            whole.setdefault(name, []).append(text)
    for name, texts in whole.items():
        write_bytes(folder / name, "".join(texts).encode())

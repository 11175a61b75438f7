"""What takes long to make, kept in files: made once, whoever asks and however often a run is
killed."""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

import numpy as np

from lidar_perception import __version__
from lidar_perception.runs.files import write_bytes
from lidar_perception.types import InputError

Made = TypeVar("Made")


class NotKept(InputError):
    """A cache cannot be written into, unlike a scene that cannot be read."""


def path_in(cache: Path | None, *what: Any) -> Path | None:
    """The file in a cache for what is made of all this; None without a cache."""
    if cache is None:
        return None
    return cache / f"{hashlib.sha1(repr((*what, __version__)).encode()).hexdigest()[:20]}.npz"


def state_of(file: Path) -> tuple[str, int, int]:
    """Another one once the content of a file is another one: where it is, bytes, and when it was
    written, ns; 0 and 0 where there is none."""
    try:
        stat = file.stat()
    except OSError:
        return str(file.resolve()), 0, 0
    return str(file.resolve()), stat.st_size, stat.st_mtime_ns


def kept(path: Path | None, make: Callable[[], Made], read: Callable[[Any], Made],
         arrays: Callable[[Made], dict[str, Any]], most_gb: float = np.inf) -> Made:
    """What read() finds in the file at path; if it is not there, or broken, what make() gives,
    whose arrays() are written there while the folder has less than most_gb. NotKept where that
    fails; None as path keeps nothing."""
    if path is not None and path.is_file():
        try:
            with np.load(path) as file:
                return read(file)
        except (OSError, ValueError, TypeError, KeyError, EOFError, BadZipFile):
            path.unlink(missing_ok=True)  # it is made again
    made = make()
    if path is not None and (most_gb == np.inf or size_of(path.parent) < most_gb * 1e9):
        try:
            write_arrays(path, arrays(made))
        except InputError as error:
            raise NotKept(str(error)) from None
    return made


def write_arrays(path: Path, arrays: dict[str, Any]) -> None:
    """Write an .npz file, as runs.files.write_bytes does. InputError where it cannot be written."""
    content = io.BytesIO()
    np.savez(content, **arrays)
    write_bytes(path, content.getbuffer())


def size_of(folder: Path) -> int:
    """Bytes of the files in a folder; 0 where there is none."""
    try:
        with os.scandir(folder) as entries:
            return sum(entry.stat().st_size for entry in entries if entry.is_file())
    except OSError:
        return 0

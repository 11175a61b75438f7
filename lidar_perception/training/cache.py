"""Cache of files that take long to compute, which interrupted and later runs reuse."""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

import numpy as np

from lidar_perception import __version__
from lidar_perception.runs.files import write_bytes
from lidar_perception.runs.processes import run_in_processes
from lidar_perception.runs.terminal import show_progress
from lidar_perception.types import InputError

Content = TypeVar("Content")


class CacheError(InputError):
    """Raised if the cache cannot be written; a scene that cannot be read is a plain InputError."""


def cache_path(cache: Path | None, *key: Any) -> Path | None:
    """Return the file of the cache for a key, which any change of the key's repr changes.

    None without a cache.
    """
    if cache is None:
        return None
    return cache / f"{hashlib.sha1(repr((*key, __version__)).encode()).hexdigest()[:20]}.npz"


def file_fingerprint(file: Path) -> tuple[str, int, int]:
    """Return path, size in bytes and modification time in ns, which change with the content.

    Size and time are 0 for a missing file.
    """
    try:
        stat = file.stat()
    except OSError:
        return str(file.resolve()), 0, 0
    return str(file.resolve()), stat.st_size, stat.st_mtime_ns


def load_or_make(
    path: Path | None,
    make: Callable[[], Content],
    read: Callable[[Any], Content],
    to_arrays: Callable[[Content], dict[str, Any]],
    max_gb: float = np.inf,
) -> Content:
    """Return the content of a cache file; make and write it if it is missing or damaged.

    Args:
        path: The .npz file, or None for no cache.
        make: Computes the content.
        read: Content from the arrays of the file.
        to_arrays: Arrays to write.
        max_gb: Write only while the folder is smaller than this.

    Raises:
        CacheError: The file cannot be written.
    """
    if path is not None and path.is_file():
        try:
            with np.load(path) as file:
                return read(file)
        except (OSError, ValueError, TypeError, KeyError, EOFError, BadZipFile):
            path.unlink(missing_ok=True)  # recreated below
    content = make()
    if path is not None and (max_gb == np.inf or folder_size(path.parent) < max_gb * 1e9):
        try:
            write_arrays(path, to_arrays(content))
        except InputError as error:
            raise CacheError(str(error)) from None
    return content


def write_arrays(path: Path, arrays: dict[str, Any]) -> None:
    """Write an .npz file atomically. Raise InputError if it cannot be written."""
    content = io.BytesIO()
    np.savez(content, **arrays)
    write_bytes(path, content.getbuffer())


def folder_size(folder: Path) -> int:
    """Return the size of the files in a folder in bytes, 0 for a missing folder."""
    try:
        with os.scandir(folder) as entries:
            return sum(entry.stat().st_size for entry in entries if entry.is_file())
    except OSError:
        return 0


def find_missing(source: Any, numbers: Sequence[int]) -> list[int]:
    """Return those of the scene numbers for which a source has no cache file yet."""
    return [i for i in numbers if (path := source.path(i)) is not None and not path.is_file()]


def fill_cache(sources: Sequence[Any], numbers: Sequence[Sequence[int]], jobs: int, title: str) -> None:
    """Cache scenes of several sources in several processes, each missing file once.

    Scenes that cannot be read are skipped here and reported when training reads them.

    Args:
        sources: Sources with path(i) and keep(i).
        numbers: Scene numbers of each source.

    Raises:
        CacheError: A file cannot be written.
    """
    items = [(k, i) for k, (source, some) in enumerate(zip(sources, numbers)) for i in find_missing(source, some)]
    if not items:
        return
    for _ in show_progress(
        run_in_processes(partial(_make_keeper, tuple(sources)), items, jobs, title), title, len(items)
    ):
        pass


def _make_keeper(sources: tuple[Any, ...]) -> Callable[[tuple[int, int]], None]:
    def keep(item: tuple[int, int]) -> None:
        try:
            sources[item[0]].keep(item[1])
        except CacheError:
            raise
        except InputError:
            return

    return keep

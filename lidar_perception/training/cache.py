"""Cache of computed files on disk, for interrupted and later runs."""

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
    """Raised if the cache cannot be written. A scene that cannot be read raises a plain InputError."""


def make_cache_path(cache: Path | None, *key: Any) -> Path | None:
    """Return the path of the cache file for a key, or None without a cache. The file name depends on the key's repr."""
    if cache is None:
        return None
    return cache / f"{hashlib.sha1(repr((*key, __version__)).encode()).hexdigest()[:20]}.npz"


def file_fingerprint(file: Path) -> tuple[str, int, int]:
    """Return path, size in bytes and modification time in ns of a file; size and time are 0 if it is missing."""
    try:
        stat = file.stat()
    except OSError:
        return str(file.resolve()), 0, 0
    return str(file.resolve()), stat.st_size, stat.st_mtime_ns


def load_or_compute(
    path: Path | None,
    compute: Callable[[], Content],
    from_arrays: Callable[[Any], Content],
    to_arrays: Callable[[Content], dict[str, Any]],
    max_gb: float = np.inf,
) -> Content:
    """Load a cache file, or compute and write its content if it is missing or damaged.

    Args:
        path: Path of the .npz file, or None for no cache.
        compute: Function that computes the content.
        from_arrays: Function that converts the arrays of the file to the content.
        to_arrays: Function that converts the content to arrays.
        max_gb: The file is written only while the folder is smaller than this.

    Raises:
        CacheError: The file cannot be written.
    """
    if path is not None and path.is_file():
        try:
            with np.load(path) as file:
                return from_arrays(file)
        except (OSError, ValueError, TypeError, KeyError, EOFError, BadZipFile):
            path.unlink(missing_ok=True)
    content = compute()
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


def fill_cache(
    sources: Sequence[Any], numbers: Sequence[Sequence[int]], jobs: int, title: str, max_gb: float = np.inf
) -> None:
    """Write the missing cache files of several sources in several processes.

    Scenes that cannot be read are skipped; training reports them later.

    Args:
        sources: Sources with cache_file(i) and load_scene(i), which writes the file.
        numbers: Scene numbers of each source.
        jobs: Number of processes.
        title: Title of the progress bar.
        max_gb: No more files are written when the folder is larger than this.

    Raises:
        CacheError: A file cannot be written.
    """
    items = [
        (source, i, path)
        for source, scene_numbers in zip(sources, numbers)
        for i in scene_numbers
        if (path := source.cache_file(i)) is not None and not path.is_file()
    ]
    if not items:
        return
    results = run_in_processes(partial(_make_store_function, max_gb), items, jobs, title)
    for _ in show_progress(results, title, len(items)):
        pass


def _make_store_function(max_gb: float) -> Callable[[tuple[Any, int, Path]], None]:
    def store(item: tuple[Any, int, Path]) -> None:
        source, i, path = item
        try:
            if max_gb == np.inf or folder_size(path.parent) < max_gb * 1e9:
                source.load_scene(i)
        except CacheError:
            raise
        except InputError:
            return

    return store

"""Locks and comparison of settings for the output folders of resumable commands."""

from __future__ import annotations

import fcntl
import hashlib
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from lidar_perception.types import InputError


def lock_file(descriptor: int, path: Path) -> str:
    """Lock an open file or folder.

    Returns "" on success, or an error message if the file system does not support locks.

    Raises:
        InputError: Another process holds the lock.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise InputError(f"another process is writing to {path}; wait until it ends, or stop it") from None
    except OSError as error:
        return error.strerror or str(error)
    return ""


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Create a folder if needed, and lock it against other processes within the block.

    After an error, folders are removed if they were created here and are still empty.

    Raises:
        InputError: The folder cannot be created, or another process has locked it.
    """
    new_folders = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except FileExistsError:
        raise InputError(f"{folder} is a file; give another name") from None
    except OSError as error:
        raise InputError(f"cannot create the folder {folder}: {error.strerror}") from None
    try:
        lock_file(descriptor, folder)
        yield
    except BaseException:
        with suppress(OSError):
            for path in new_folders:
                path.rmdir()
        raise
    finally:
        os.close(descriptor)


def find_differences(old_settings: dict[str, Any], settings: dict[str, Any]) -> list[str]:
    """Describe each setting that differs from an earlier run, such as "frames 5, not 6".

    Settings in nested dicts have dotted names. Settings that only the earlier run has are ignored.
    """
    differences = []
    for key, value in settings.items():
        old_value = old_settings.get(key)
        if isinstance(value, dict) and isinstance(old_value, dict):
            differences += [f"{key}.{line}" for line in find_differences(old_value, value)]
        elif old_value != value:
            differences.append(f"{key} {old_value!r}, not {value!r}")
    return differences


def hash_names(names: Iterable[str]) -> str:
    """Return a short hash of names, such as frame names; it depends on their order."""
    return hashlib.sha256("\n".join(names).encode()).hexdigest()[:12]

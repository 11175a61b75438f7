"""Locks and comparison of settings, for folders that are written in many steps."""

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
    """Lock an open file or folder; return "", or the reason if the file system has no locks.

    Raises:
        InputError: while another process holds the lock.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise InputError(f"another process is writing {path}; wait for it or end it") from None
    except OSError as error:
        return error.strerror or str(error)
    return ""


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Create the folder if needed, and keep other processes from writing into it.

    After an error, folders that were created here and are still empty are removed.
    """
    created = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except FileExistsError:
        raise InputError(f"{folder} is a file; give another name") from None
    except OSError as error:
        raise InputError(f"cannot make the folder {folder}: {error.strerror}") from None
    try:
        lock_file(descriptor, folder)
        yield
    except BaseException:
        with suppress(OSError):
            for path in created:
                path.rmdir()
        raise
    finally:
        os.close(descriptor)


def find_differences(before: dict[str, Any], asked: dict[str, Any]) -> list[str]:
    """Describe the settings that differ from before, as in "frames 5, not 6".

    Nested dicts have dotted names; keys that only `before` has are ignored.
    """
    found = []
    for key, value in asked.items():
        old = before.get(key)
        if isinstance(value, dict) and isinstance(old, dict):
            found += [f"{key}.{line}" for line in find_differences(old, value)]
        elif old != value:
            found.append(f"{key} {old!r}, not {value!r}")
    return found


def hash_names(names: Iterable[str]) -> str:
    """Return a short hash of names, such as those of frames, in their order."""
    return hashlib.sha256("\n".join(names).encode()).hexdigest()[:12]

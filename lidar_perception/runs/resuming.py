"""Folders that are made in many steps: by one process at a time, and resumed only with identical
settings."""

from __future__ import annotations

import fcntl
import hashlib
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from lidar_perception.types import InputError


def claim(descriptor: int, path: Path) -> str:
    """Lock what is open for this process; "", or why the file system has no locks. InputError while
    another process has it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise InputError(f"another process is writing {path}; wait for it or end it") from None
    except OSError as error:
        return error.strerror or str(error)
    return ""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Make the folder if need be, and keep a second process from writing into it. After an error,
    folders that were made here and are still empty are removed."""
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except FileExistsError:
        raise InputError(f"{folder} is a file; give another name") from None
    except OSError as error:
        raise InputError(f"cannot make the folder {folder}: {error.strerror}") from None
    try:
        claim(descriptor, folder)
        yield
    except BaseException:
        with suppress(OSError):
            for each in made:
                each.rmdir()
        raise
    finally:
        os.close(descriptor)


def differences(before: dict[str, Any], asked: dict[str, Any]) -> list[str]:
    """What is asked for otherwise than before: "frames 5, not 6". Dicts in dicts have dotted
    names; what is only in `before` is passed over."""
    found = []
    for key, value in asked.items():
        old = before.get(key)
        if isinstance(value, dict) and isinstance(old, dict):
            found += [f"{key}.{line}" for line in differences(old, value)]
        elif old != value:
            found.append(f"{key} {old!r}, not {value!r}")
    return found


def digest(names: Iterable[str]) -> str:
    """Short for many names, such as of frames: that of others, or in another order, is another."""
    return hashlib.sha256("\n".join(names).encode()).hexdigest()[:12]

"""Writing files so that a crash never destroys what was there."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from lidar_perception.types import InputError


def write_text(path: str | Path, text: str) -> None:
    """Write, fsync, rename: path holds the old text or the whole new one, never a part. InputError
    where it cannot be written."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "w", encoding="utf-8") as stream:
            stream.write(text if text.endswith("\n") else text + "\n")
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        raise InputError(f"cannot write {path}: {error.strerror}") from None

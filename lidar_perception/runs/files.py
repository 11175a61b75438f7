"""Writing files so that a crash never destroys what was there."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from lidar_perception.types import InputError


def write_text(path: str | Path, text: str) -> None:
    """As write_bytes, UTF-8, with a line feed at the end."""
    write_bytes(path, (text if text.endswith("\n") else text + "\n").encode())


def write_bytes(path: str | Path, content: bytes | memoryview) -> None:
    """Write, fsync, rename: path holds the old content or the whole new one, never a part.
    InputError where it cannot be written."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        raise InputError(f"cannot write {path}: {error.strerror}") from None


def remove_temporaries(folder: Path) -> None:
    """Remove what a killed process left in folder of the files it was writing."""
    for path in folder.rglob(".*.tmp"):
        path.unlink(missing_ok=True)

"""Writing files so that a crash never destroys what was there, and reading small ones that anyone
may have written."""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path

from lidar_perception.types import InputError


def regular(path: Path) -> Path:
    """The path itself. InputError for what is neither file nor folder, such as a pipe or a device,
    from which a read may wait for ever; what is not there passes."""
    if path.exists() and not path.is_file() and not path.is_dir():
        raise InputError(f"{path} is no file; give the path of one")
    return path


def read_text(path: str | Path, max_bytes: int) -> str:
    """The UTF-8 text of a file of at most max_bytes. InputError where it cannot be read; also for
    what is no file, such as a pipe, from which a read may wait for ever."""
    path = Path(path)
    try:
        with open(regular(path), "rb") as stream:
            content = stream.read(max_bytes + 1)
        if len(content) > max_bytes:
            raise InputError(f"{path} has more than {max_bytes} bytes, which is no file of this "
                             "kind; give another one")
        return content.decode()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"cannot read {path}: it is no UTF-8 text ({error.reason} at byte "
                         f"{error.start})") from None


def short(error: BaseException, length: int = 200) -> str:
    """What an error says, in one line of at most so many characters; its type if it is silent."""
    line = (str(error).strip().splitlines() or [type(error).__name__])[0]
    return line if len(line) <= length else f"{line[:length - 3]}..."


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


def make_folder(path: Path) -> None:
    """Make a folder, with those above it, if it is not there. InputError where that cannot be, or
    nothing can be written into it."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        if not os.access(path, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except FileExistsError:
        raise InputError(f"{path} is a file; give the name of a folder") from None
    except OSError as error:
        raise InputError(f"cannot write into the folder {path}: {error.strerror}") from None


def remove_temporaries(folder: Path) -> None:
    """Remove what a killed process left in folder of the files it was writing."""
    for path in folder.rglob(".*.tmp"):
        path.unlink(missing_ok=True)

"""Atomic writing of files and folders, and reading of small files with checks."""

from __future__ import annotations

import errno
import itertools
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from fnmatch import fnmatch
from pathlib import Path

from lidar_perception.types import InputError

_calls = itertools.count()


def check_regular(path: Path) -> Path:
    """Return the path if it is a regular file or a folder, or does not exist.

    Raises:
        InputError: The path is a pipe or a device, on which a read could block, or its name is
            invalid.
    """
    if "\0" in str(path):
        raise InputError(f"{str(path)!r} is not a valid file name; correct it")
    if path.exists() and not path.is_file() and not path.is_dir():
        raise InputError(f"{path} is not a regular file")
    return path


MAX_TEXT_BYTES = 2**28  # maximum size of a file of numbers or labels
MAX_LINE = 200  # maximum length of an error message


def read_text(path: str | Path, max_bytes: int = MAX_TEXT_BYTES, noun: str = "") -> str:
    """Read a UTF-8 text file of at most max_bytes and drop its byte order mark.

    Args:
        noun: Description of the file in error messages.

    Raises:
        InputError: The file cannot be read, is too large, or is a pipe or a device.
    """
    title = f"{noun} {path}" if noun else str(path)
    path = Path(path)
    try:
        with open(check_regular(path), "rb") as stream:
            content = stream.read(max_bytes + 1)
        if len(content) > max_bytes:
            raise InputError(
                f"{path} has more than {max_bytes} bytes, which is too large for this file format; give another file"
            )
        return content.decode("utf-8-sig")  # some editors write a byte order mark
    except OSError as error:
        raise InputError(f"cannot read {title}: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"cannot read {title}: it is not UTF-8 text ({error.reason} at byte {error.start})") from None


@contextmanager
def convert_os_errors() -> Iterator[None]:
    """Convert an OSError about a file, such as a missing permission, to InputError."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            raise
        raise InputError(f"{error.filename}: {error.strerror}") from error


def shorten_error(error: BaseException) -> str:
    """Return the first line of an error message, cut to MAX_LINE characters; the type if it is empty."""
    line = (str(error).strip().splitlines() or [type(error).__name__])[0]
    return line if len(line) <= MAX_LINE else f"{line[: MAX_LINE - 3]}..."


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text atomically, with a line feed at the end; see write_bytes."""
    write_bytes(path, (text if text.endswith("\n") else text + "\n").encode())


def write_bytes(path: str | Path, content: bytes | memoryview) -> None:
    """Write a file atomically, so that it is never incomplete. Raise InputError if it cannot be written."""
    path = Path(path)
    temporary = _make_temporary_path(path)
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


def _make_temporary_path(path: Path) -> Path:
    """Return a hidden path in the same folder that is unique to this process and call."""
    require_name(path)
    return path.with_name(f".{path.name}.{os.getpid()}-{next(_calls)}.tmp")


def require_name(path: Path) -> None:
    """Raise InputError for a path without a name, such as `.`; temporary files need a name."""
    if not path.name:
        raise InputError(f"{path} is not the name of a new file; give a name, such as {path / 'out'}")


def check_unused(path: Path, force: bool) -> None:
    """Raise InputError if the path exists, unless `force` is True."""
    if path.exists() and not force:
        raise InputError(f"{path} already exists; give another name or --force")


def refuse_other_files(folder: Path, own_patterns: Iterable[str]) -> None:
    """Raise InputError if a folder has files that do not match any of the patterns.

    Call this before removing the content of the folder, to protect files of other programs.
    """
    own_patterns = [*own_patterns, "*.tmp"]
    if other_names := sorted(
        path.name for path in folder.iterdir() if not any(fnmatch(path.name, pattern) for pattern in own_patterns)
    ):
        raise InputError(
            f"{folder} has {len(other_names)} other files, such as {other_names[0]}, "
            "which would be removed; move them away, or give another name"
        )


@contextmanager
def write_folder(path: Path, force: bool = False) -> Iterator[Path]:
    """Yield a temporary folder; its files are moved to `path` if the block ends without an error.

    With force, they replace files with the same names.

    Raises:
        InputError: The files cannot be written; `path` exists and force is False; or `path` has
            files that would not be replaced.
    """
    check_unused(path, force)
    temporary = _make_temporary_path(path)
    try:
        make_folder(temporary)
        yield temporary
        new_files = {file.relative_to(temporary) for file in temporary.rglob("*") if not file.is_dir()}
        old_files = {file.relative_to(path) for file in path.rglob("*") if not file.is_dir()}
        if remaining_files := sorted(old_files - new_files):
            raise InputError(
                f"{path} has {len(remaining_files)} files that would not be replaced, such as "
                f"{remaining_files[0]}; remove the folder, or give another name"
            )
        if not path.exists():
            temporary.rename(path)
        for file in sorted(new_files if temporary.exists() else ()):
            (path / file).parent.mkdir(parents=True, exist_ok=True)
            (temporary / file).replace(path / file)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from None
    except InputError as error:
        raise InputError(str(error).replace(str(temporary), str(path))) from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def check_writable_folder(path: Path) -> None:
    """Raise InputError if a folder cannot be created or written to, without creating it."""
    existing = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not existing.is_dir():
        raise InputError(f"cannot write to the folder {path}: {existing} is a file")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(f"cannot write to the folder {path}: {os.strerror(errno.EACCES)}")


def make_folder(path: Path) -> None:
    """Create a folder and its parents if needed. Raise InputError if it cannot be created or written to."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        if not os.access(path, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except FileExistsError:
        raise InputError(f"{path} is a file; give the name of a folder") from None
    except OSError as error:
        raise InputError(f"cannot write to the folder {path}: {error.strerror}") from None


def remove_temporaries(folder: Path, *names: str) -> None:
    """Remove the temporary files of a killed process from a folder, but not from its subfolders.

    No other process may write to the folder at the same time.

    Args:
        names: Patterns of the names of the final files.
    """
    for path in folder.glob(".*.tmp"):
        match = re.fullmatch(r"\.(.+)\.\d+-\d+\.tmp", path.name)  # see _make_temporary_path
        if match and any(fnmatch(match[1], name) for name in names) and path.is_file():
            path.unlink(missing_ok=True)

"""Writing files so that a crash never destroys what was there, and reading small ones that anyone
may have written."""

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


def regular(path: Path) -> Path:
    """The path itself. InputError for what is neither file nor folder, such as a pipe or a device,
    from which a read may wait for ever, and for a name that no file can have; what is not there
    passes."""
    if "\0" in str(path):
        raise InputError(f"{str(path)!r} is no name of a file; correct it where it comes from")
    if path.exists() and not path.is_file() and not path.is_dir():
        raise InputError(f"{path} is no file; give the path of one")
    return path


MAX_TEXT = 2**28  # bytes of a file of numbers or labels


def read_text(path: str | Path, max_bytes: int = MAX_TEXT, what: str = "") -> str:
    """Read the UTF-8 text of a file of at most max_bytes, without a byte order mark. InputError,
    in which `what` describes the file, where it cannot be read; also for a pipe or a device, from
    which a read may wait for ever."""
    named = f"{what} {path}" if what else str(path)
    path = Path(path)
    try:
        with open(regular(path), "rb") as stream:
            content = stream.read(max_bytes + 1)
        if len(content) > max_bytes:
            raise InputError(f"{path} has more than {max_bytes} bytes, which is no file of this "
                             "kind; give another one")
        return content.decode("utf-8-sig")  # as editors of Windows begin it
    except OSError as error:
        raise InputError(f"cannot read {named}: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"cannot read {named}: it is no UTF-8 text ({error.reason} at byte "
                         f"{error.start})") from None


@contextmanager
def refusals_named() -> Iterator[None]:
    """A file that the system refuses (no permission, too long a name) is an InputError."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            raise
        raise InputError(f"{error.filename}: {error.strerror}") from error


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
    temporary = _beside(path)
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


def _beside(path: Path) -> Path:
    """A hidden name in the same folder that no other process and no other call takes. InputError
    for a path that ends with no name."""
    require_name(path)
    return path.with_name(f".{path.name}.{os.getpid()}-{next(_calls)}.tmp")


def require_name(path: Path) -> None:
    """InputError for a path, such as `.`, without a name of its own, beside which something is
    written first."""
    if not path.name:
        raise InputError(f"{path} is no name for something new; give one, such as {path / 'out'}")


def check_free(path: Path, force: bool) -> None:
    """InputError for what is there already, but with force."""
    if path.exists() and not force:
        raise InputError(f"{path} exists already; give another name or --force")


def refuse_others(folder: Path, ours: Iterable[str]) -> None:
    """InputError that names what is in a folder beside what fits the patterns of `ours`, and would
    be removed with it."""
    ours = [*ours, "*.tmp"]
    if others := sorted(path.name for path in folder.iterdir()
                        if not any(fnmatch(path.name, pattern) for pattern in ours)):
        raise InputError(f"{folder} has other files too ({len(others)}, such as {others[0]}), "
                         "which would be removed; move them away, or give another name")


@contextmanager
def whole_folder(path: Path, force: bool = False) -> Iterator[Path]:
    """A folder to write into, whose files appear under `path` when all of them are complete; after
    an error there is nothing new. InputError where they cannot be written or `path` exists; with
    force they replace files of the same names there, and InputError names a file that would be left
    among them."""
    check_free(path, force)
    hidden = _beside(path)
    try:
        make_folder(hidden)
        yield hidden
        new = {file.relative_to(hidden) for file in hidden.rglob("*") if not file.is_dir()}
        old = {file.relative_to(path) for file in path.rglob("*") if not file.is_dir()}
        if left := sorted(old - new):
            raise InputError(f"{path} has files that would not be replaced ({len(left)}, such as "
                             f"{left[0]}); remove the folder yourself, or give another name")
        if not path.exists():
            hidden.rename(path)
        for file in sorted(new if hidden.exists() else ()):
            (path / file).parent.mkdir(parents=True, exist_ok=True)
            (hidden / file).replace(path / file)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from None
    except InputError as error:
        raise InputError(str(error).replace(str(hidden), str(path))) from None
    finally:
        shutil.rmtree(hidden, ignore_errors=True)


def check_folder(path: Path) -> None:
    """Raise InputError if a folder cannot be made or written into. Nothing is made."""
    above = next(each for each in (path, *path.absolute().parents) if each.exists())
    if not above.is_dir():
        raise InputError(f"cannot write into the folder {path}: {above} is a file")
    if not os.access(above, os.W_OK | os.X_OK):
        raise InputError(f"cannot write into the folder {path}: {os.strerror(errno.EACCES)}")


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


def remove_temporaries(folder: Path, *names: str) -> None:
    """Remove what a killed process left in folder, not in those below, of files that it was writing
    under names that fit one of these patterns. Nobody may be writing there."""
    for path in folder.glob(".*.tmp"):
        written = re.fullmatch(r"\.(.+)\.\d+-\d+\.tmp", path.name)  # see _beside
        if written and any(fnmatch(written[1], name) for name in names) and path.is_file():
            path.unlink(missing_ok=True)

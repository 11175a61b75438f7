"""Every action in a file, before it counts: a kill loses nothing but a line that was half written.

The first line says of which drive it is; each further line is an action, with its number. Lines are
appended and brought to the disk one by one.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from lidar_perception.runs.resuming import find_differences, lock_file, lock_folder
from lidar_perception.types import InputError

NAME, VERSION = "journal.jsonl", 1


def header(drive: str, names: Sequence[str], stamps_ns: Sequence[int],
           clouds: str = "", posed: bool | None = None) -> dict[str, Any]:
    """What a journal says of its drive: one of other frames is another. clouds: a digest of some;
    where it is the same, the folder of the drive may have any name. posed: whether the drive knows
    where the sensor was."""
    stamps = hashlib.sha256(" ".join(map(str, stamps_ns)).encode()).hexdigest()[:16]
    return {"journal": VERSION, "drive": drive, "frames": len(names),
            "first": names[0] if names else "", "last": names[-1] if names else "",
            "stamps_sha": stamps, "clouds": clouds, "posed": posed}


def _encoded(line: Mapping[str, Any]) -> bytes:
    return (json.dumps(line, allow_nan=False, separators=(",", ":")) + "\n").encode()


class Journal:
    """The journal of a folder. lines: the actions that were in it when it was opened; message: what
    had to be mended, or None."""

    def __init__(self, folder: Path, head: Mapping[str, Any]) -> None:
        self.path = folder / NAME
        self.message: str | None = None
        self._head = dict(head)
        self.lines: list[dict[str, Any]] = []
        try:
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise InputError(f"cannot open {self.path}: {error.strerror}") from None
        try:
            if why := lock_file(self._file, self.path):  # on NFS the lock of its folder is none
                self.message = (f"{self.path} cannot be locked ({why}): let no second process "
                                "label this drive")
            self._size = self._read()
            if self._size == 0:
                self.append(self._head)
                _sync_folder(folder)
        except BaseException:
            self.close()
            raise

    def append(self, line: Mapping[str, Any]) -> None:
        """Write a line, to the disk. InputError where that cannot be; the file is as it was."""
        content, there = _encoded(line), os.fstat(self._file)
        if there.st_nlink == 0:  # what is written would be gone with this process
            raise InputError(f"{self.path} was removed or replaced; nothing was done: export what "
                             "there is, and start again")
        if there.st_size != self._size:  # on a file system without locks
            raise InputError(f"another process has written {self.path}; nothing was done: end one "
                             "of them, and start again")
        try:
            view = memoryview(content)
            while view:
                view = view[os.pwrite(self._file, view,
                                      self._size + len(content) - len(view)):]
            os.fsync(self._file)
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(self._file, self._size)
            raise InputError(f"cannot write {self.path}: {error.strerror}; nothing was done, make "
                             "room and do it again") from None
        self._size += len(content)

    def close(self) -> None:
        """No more lines."""
        with suppress(OSError):
            os.close(self._file)

    def _read(self) -> int:
        """Take the lines, and cut off one that was not written to its end; the size that is left.
        InputError for a journal of another drive, or one that is broken within."""
        with open(self.path, "rb") as stream:
            content = stream.read()
        whole = content.rfind(b"\n") + 1
        lines = content[:whole].splitlines()
        found = [self._parsed(text, number) for number, text in enumerate(lines, 1)]
        if found:
            self._check(found[0])
        elif content and not _encoded(self._head).startswith(content):
            raise InputError(f"{self.path} is no journal of labels; move it away")
        if whole < len(content):
            os.ftruncate(self._file, whole)
            os.fsync(self._file)
            self.message = (f"the last line of {self.path} was not written to its end, so "
                            f"{len(content) - whole} bytes were cut off; one action may be lost")
        self.lines = found[1:]
        for number, line in enumerate(self.lines, 1):
            if line.get("seq") != number:
                raise InputError(f"{self.path}:{number + 1} is action {line.get('seq')}, not "
                                 f"{number}; the file was changed by something else")
        return whole

    def _parsed(self, text: bytes, number: int) -> dict[str, Any]:
        try:
            line = json.loads(text)
            if not isinstance(line, dict):
                raise ValueError("it is no object")
            return line
        except (ValueError, RecursionError) as error:
            raise InputError(f"{self.path}:{number} is no line of a journal ({error}); restore the "
                             "file or move it away") from None

    def _check(self, found: Mapping[str, Any]) -> None:
        asked = dict(self._head)
        if not found.get("clouds") or not asked["clouds"]:  # a journal of before, or broken clouds
            asked.pop("clouds")
        elif found["clouds"] == asked["clouds"]:
            asked.pop("drive")
        posed = asked.pop("posed", None), found.get("posed")  # the latter None: of before
        if set(posed) == {True, False}:
            now, then = ("with" if each else "without" for each in posed)
            raise InputError(f"{self.path} was made {then} poses of the sensor, and the drive is "
                             f"{now} them now, by which boxes between those set by hand would be "
                             "others; give the drive as it was, or another --out")
        if different := find_differences({k: found.get(k) for k in asked}, asked):
            raise InputError(f"{self.path} is the journal of another drive: "
                             f"{'; '.join(different)}; give another --out")


def _sync_folder(folder: Path) -> None:
    """So that a new file's name is on the disk too."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def opened(folder: Path, head: Mapping[str, Any]) -> Iterator[Journal]:
    """The journal of a folder, which is made if need be. InputError while another process has
    it."""
    with lock_folder(folder):
        journal = Journal(folder, head)
        try:
            yield journal
        finally:
            journal.close()

"""Journal file of a labelling session: every action is on disk before it takes effect.

If the process is killed, at most an incomplete last line is lost. The first line identifies the
drive; each further line is a numbered action.
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

JOURNAL_NAME, VERSION = "journal.jsonl", 1


def make_journal_header(
    drive: str, names: Sequence[str], stamps_ns: Sequence[int], cloud_digest: str = "", has_poses: bool | None = None
) -> dict[str, Any]:
    """Make the first line of a journal, which identifies the drive by its frames.

    Args:
        drive: Name of the drive. It is not compared if `cloud_digest` matches.
        cloud_digest: Digest of some of the clouds, or "" if unknown.
        has_poses: True if the drive has sensor poses.
    """
    stamps = hashlib.sha256(" ".join(map(str, stamps_ns)).encode()).hexdigest()[:16]
    return {
        "journal": VERSION,
        "drive": drive,
        "frames": len(names),
        "first": names[0] if names else "",
        "last": names[-1] if names else "",
        "stamps_sha": stamps,
        "clouds": cloud_digest,
        "posed": has_poses,
    }


def _encode(line: Mapping[str, Any]) -> bytes:
    return (json.dumps(line, allow_nan=False, separators=(",", ":")) + "\n").encode()


class Journal:
    """Journal in a folder.

    Attributes:
        lines: Actions that the journal contained when it was opened.
        message: Warning about the file, or None.
    """

    def __init__(self, folder: Path, header: Mapping[str, Any]) -> None:
        self.path = folder / JOURNAL_NAME
        self.message: str | None = None
        self._header = dict(header)
        self.lines: list[dict[str, Any]] = []
        try:
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise InputError(f"cannot open {self.path}: {error.strerror}") from None
        try:
            if reason := lock_file(self._file, self.path):  # the folder's lock has no effect on NFS
                self.message = f"{self.path} cannot be locked ({reason}): do not label this drive from a second process"
            self._size = self._read_lines()
            if self._size == 0:
                self.append(self._header)
                _sync_folder(folder)
        except BaseException:
            self.close()
            raise

    def append(self, line: Mapping[str, Any]) -> None:
        """Write a line and sync it to disk. Raises InputError, with the file unchanged, if that fails."""
        content, status = _encode(line), os.fstat(self._file)
        if status.st_nlink == 0:  # a file without a name is deleted when this process ends
            raise InputError(f"{self.path} was removed or replaced; export your labels and restart the server")
        if status.st_size != self._size:  # possible on a file system without locks
            raise InputError(f"another process has written to {self.path}; stop one of the two and restart the other")
        try:
            view = memoryview(content)
            while view:
                view = view[os.pwrite(self._file, view, self._size + len(content) - len(view)) :]
            os.fsync(self._file)
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(self._file, self._size)
            raise InputError(f"cannot write {self.path}: {error.strerror}; free disk space and try again") from None
        self._size += len(content)

    def close(self) -> None:
        """Close the file."""
        with suppress(OSError):
            os.close(self._file)

    def _read_lines(self) -> int:
        """Read all lines, remove an incomplete last line, and return the size of the file.

        Raises:
            InputError: The journal is damaged or belongs to another drive.
        """
        with open(self.path, "rb") as stream:
            content = stream.read()
        end = content.rfind(b"\n") + 1
        lines = content[:end].splitlines()
        records = [self._parse_line(text, number) for number, text in enumerate(lines, 1)]
        if records:
            self._check_header(records[0])
        elif content and not _encode(self._header).startswith(content):
            raise InputError(f"{self.path} is not a labelling journal; move it away")
        if end < len(content):
            os.ftruncate(self._file, end)
            os.fsync(self._file)
            self.message = (
                f"the last line of {self.path} was incomplete and has been removed "
                f"({len(content) - end} bytes); one action may be lost"
            )
        self.lines = records[1:]
        for number, line in enumerate(self.lines, 1):
            if line.get("seq") != number:
                raise InputError(
                    f"{self.path}:{number + 1} has action number {line.get('seq')}, expected {number}; "
                    "another program has changed the file: restore it or move it away"
                )
        return end

    def _parse_line(self, text: bytes, number: int) -> dict[str, Any]:
        try:
            line = json.loads(text)
            if not isinstance(line, dict):
                raise ValueError("not a JSON object")
            return line
        except (ValueError, RecursionError) as error:
            raise InputError(
                f"{self.path}:{number} is not a valid journal entry ({error}); restore the file or move it away"
            ) from None

    def _check_header(self, header: Mapping[str, Any]) -> None:
        expected = dict(self._header)
        if not header.get("clouds") or not expected["clouds"]:  # the clouds could not be read
            expected.pop("clouds")
        elif header["clouds"] == expected["clouds"]:
            expected.pop("drive")
        pose_flags = expected.pop("posed", None), header.get("posed")
        if set(pose_flags) == {True, False}:
            current_text, recorded_text = ("with" if has_poses else "without" for has_poses in pose_flags)
            raise InputError(
                f"{self.path} was recorded {recorded_text} sensor poses, but the drive is now opened {current_text} "
                "poses, which would change all interpolated boxes; open the drive as before, or choose another --out"
            )
        if differences := find_differences({k: header.get(k) for k in expected}, expected):
            raise InputError(
                f"{self.path} is the journal of another drive: {'; '.join(differences)}; choose another --out"
            )


def _sync_folder(folder: Path) -> None:
    """Sync a folder to disk, so that the name of a new file is not lost."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def open_journal(folder: Path, header: Mapping[str, Any]) -> Iterator[Journal]:
    """Open or create the journal in a folder. Raises InputError if another process uses the folder."""
    with lock_folder(folder):
        journal = Journal(folder, header)
        try:
            yield journal
        finally:
            journal.close()

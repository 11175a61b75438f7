"""The folder of a run over frames: frames.jsonl holds its settings and then one record a line, so
that a run that was stopped at any moment resumes where it stopped."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from io import BufferedWriter
from pathlib import Path
from time import monotonic
from typing import Any

from lidar_perception.runs.files import write_text
from lidar_perception.runs.resuming import differences, locked
from lidar_perception.types import InputError

NAME = "frames.jsonl"
SYNC_S = 1.0  # at most this much is lost when the machine stops


class Journal:
    """lines: name of a finished frame -> its record as JSON."""

    def __init__(self, path: Path, plan: dict[str, Any], lines: dict[str, str],
                 stream: BufferedWriter) -> None:
        self.path, self.plan, self.lines = path, plan, lines
        self._stream, self._synced = stream, monotonic()

    def add(self, line: str) -> None:
        """Write the record of one more frame."""
        self.lines[json.loads(line)["frame"]] = line
        try:
            self._stream.write(line.encode() + b"\n")
            self._stream.flush()
            if monotonic() - self._synced > SYNC_S:
                self.sync()
        except OSError as error:
            raise InputError(f"cannot write {self.path}: {error.strerror}; finished frames are "
                             "kept, the same command resumes the run") from None

    def sync(self) -> None:
        """Flush the file to disk."""
        os.fsync(self._stream.fileno())
        self._synced = monotonic()

    def sort(self, names: list[str]) -> None:
        """Rewrite the file with the records in the order of these names, before those of other
        frames."""
        ordered = [self.lines[name] for name in names if name in self.lines]
        known = set(names)
        others = [line for name, line in self.lines.items() if name not in known]
        write_text(self.path, "\n".join([_head(self.plan), *ordered, *others]))


@contextmanager
def journal(folder: Path, plan: dict[str, Any], *, force: bool = False,
            written: Callable[[Path], Iterable[Path]] = lambda folder: ()) -> Iterator[Journal]:
    """Open the journal of a run in a folder, which is made if need be. Frames that were skipped
    before are not in it, so that they are tried again. written(folder) lists the other files
    of an earlier run, which force removes.

    InputError if the folder holds a run of another plan, or something else, unless force, which
    starts over; or if another process writes there.
    """
    with locked(folder):
        path = folder / NAME
        lines = {} if force else _begun(folder, plan)
        if force and path.exists():  # or what has our names there is somebody else's
            for old in (*written(folder), path):
                old.unlink(missing_ok=True)
        for old in folder.glob(f".{NAME}.*.tmp"):  # of a process that was killed while it wrote
            old.unlink()
        write_text(path, "\n".join([_head(plan), *lines.values()]))
        stream = open(path, "ab")
        opened = Journal(path, plan, lines, stream)
        try:
            yield opened
        finally:
            for last in (opened.sync, stream.close):
                with suppress(OSError):  # of a disk that is full; add() has said so
                    last()


def skipped_frames(folder: Path) -> dict[str, str]:
    """Return name -> reason of the frames that the run in a folder skipped; nothing where there is
    no run."""
    with suppress(OSError, ValueError, TypeError):
        lines = (folder / NAME).read_text(errors="replace").splitlines()[1:]
        records = [json.loads(line) for line in lines if '"skipped"' in line]
        return {each["frame"]: each["skipped"] for each in records if "skipped" in each}
    return {}


def _head(plan: dict[str, Any]) -> str:
    return json.dumps({"plan": plan})


def _begun(folder: Path, plan: dict[str, Any]) -> dict[str, str]:
    """The records that a run of this plan has left in the folder."""
    path = folder / NAME
    if not path.exists():
        if any(not old.name.startswith(f".{NAME}.") for old in folder.iterdir()):
            raise InputError(f"{folder} exists already and holds no run of this command; give "
                             "another name, or --force to write into it")
        return {}
    try:
        head, *rest = path.read_text(errors="replace").split("\n")
        before = json.loads(head)["plan"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"cannot read {path}: {error!r}; --force starts again") from None
    if different := differences(before, json.loads(json.dumps(plan))):
        raise InputError(f"{folder} was begun with {'; '.join(different)}; give another name, or "
                         "start again with --force")
    return {record["frame"]: line for line in rest if (record := _record(line))}


def _record(line: str) -> dict | None:
    """The record of a line; None if it was cut, or the frame was skipped."""
    with suppress(ValueError):
        record = json.loads(line)
        if isinstance(record, dict) and "frame" in record and "skipped" not in record:
            return record
    return None

"""Journal of a run over frames, with which an interrupted run can be resumed.

The first line of frames.jsonl has the settings; each further line has the record of a frame.
"""

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
from lidar_perception.runs.resuming import find_differences, lock_folder
from lidar_perception.types import InputError

JOURNAL_NAME = "frames.jsonl"
SYNC_S = 1.0  # maximum age of records that are not yet on disk, which are lost if the machine crashes


class Journal:
    """Journal that is open for writing.

    Attributes:
        path: The journal file.
        plan: Settings of the run.
        lines: JSON record of each finished frame, by frame name.
    """

    def __init__(self, path: Path, plan: dict[str, Any], lines: dict[str, str], stream: BufferedWriter) -> None:
        self.path, self.plan, self.lines = path, plan, lines
        self._stream, self._sync_time = stream, monotonic()

    def add(self, line: str) -> None:
        """Write the record of a frame."""
        self.lines[json.loads(line)["frame"]] = line
        try:
            self._stream.write(line.encode() + b"\n")
            self._stream.flush()
            if monotonic() - self._sync_time > SYNC_S:
                self.sync()
        except OSError as error:
            raise InputError(
                f"cannot write {self.path}: {error.strerror}; finished frames are "
                "saved, and the same command resumes the run"
            ) from None

    def sync(self) -> None:
        """Flush the file to disk."""
        os.fsync(self._stream.fileno())
        self._sync_time = monotonic()

    def sort(self, names: list[str]) -> None:
        """Rewrite the file with the records in the order of names; other frames come last."""
        ordered_lines = [self.lines[name] for name in names if name in self.lines]
        known_names = set(names)
        other_lines = [line for name, line in self.lines.items() if name not in known_names]
        write_text(self.path, "\n".join([_format_head(self.plan), *ordered_lines, *other_lines]))


@contextmanager
def open_journal(
    folder: Path,
    plan: dict[str, Any],
    *,
    force: bool = False,
    list_files: Callable[[Path], Iterable[Path]] = lambda folder: (),
) -> Iterator[Journal]:
    """Open the journal of a run in a folder; the folder is created if needed.

    Frames that an earlier run skipped are not in the journal, so that they are processed again.

    Args:
        plan: Settings of the run.
        force: Start over.
        list_files: Function that lists the other files of an earlier run, which force removes.

    Raises:
        InputError: The folder has other files or a run with different settings, and force is False;
            or another process writes to the folder.
    """
    with lock_folder(folder):
        path = folder / JOURNAL_NAME
        lines = {} if force else _read_records(folder, plan)
        if force and path.exists():  # without a journal, the files may belong to another program
            for old_file in (*list_files(folder), path):
                old_file.unlink(missing_ok=True)
        for old_file in folder.glob(f".{JOURNAL_NAME}.*.tmp"):  # these files remain if a process is killed
            old_file.unlink()
        write_text(path, "\n".join([_format_head(plan), *lines.values()]))
        stream = open(path, "ab")
        journal = Journal(path, plan, lines, stream)
        try:
            yield journal
        finally:
            for close_step in (journal.sync, stream.close):
                with suppress(OSError):  # add() has already reported that the disk is full
                    close_step()


def read_skipped_frames(folder: Path) -> dict[str, str]:
    """Return the reason for each skipped frame, by frame name; {} if the folder has no run."""
    with suppress(OSError, ValueError, TypeError):
        lines = (folder / JOURNAL_NAME).read_text(errors="replace").splitlines()[1:]
        records = [json.loads(line) for line in lines if '"skipped"' in line]
        return {record["frame"]: record["skipped"] for record in records if "skipped" in record}
    return {}


def _format_head(plan: dict[str, Any]) -> str:
    return json.dumps({"plan": plan})


def _read_records(folder: Path, plan: dict[str, Any]) -> dict[str, str]:
    """Read the records of an earlier run with the same plan; return {} if the folder is empty."""
    path = folder / JOURNAL_NAME
    if not path.exists():
        if any(not path_in_folder.name.startswith(f".{JOURNAL_NAME}.") for path_in_folder in folder.iterdir()):
            raise InputError(
                f"{folder} already exists and has no run of this command; give "
                "another name, or --force to write to this folder"
            )
        return {}
    try:
        header, *record_lines = path.read_text(errors="replace").split("\n")
        recorded_plan = json.loads(header)["plan"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"cannot read {path}: {error!r}; use --force to start again") from None
    if differences := find_differences(recorded_plan, json.loads(json.dumps(plan))):
        raise InputError(
            f"{folder} has a run with other settings ({'; '.join(differences)}); give another name, or use --force to "
            "start again"
        )
    return {record["frame"]: line for line in record_lines if (record := _parse_record(line))}


def _parse_record(line: str) -> dict | None:
    """Parse a record; return None if the line is incomplete or the frame was skipped."""
    with suppress(ValueError):
        record = json.loads(line)
        if isinstance(record, dict) and "frame" in record and "skipped" not in record:
            return record
    return None

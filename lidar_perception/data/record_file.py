"""A file that grows by whole records, also where the disk is full."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any


class RecordFile:
    """A stream for one writer; a context manager. Each write() is a record: one that does not fit
    leaves no part of itself behind and raises OSError, and so do all after it."""

    def __init__(self, path: Path):
        self.file = open(path, "wb", buffering=0)
        self.failure: OSError | None = None
        self.records = [(-1, 0)]  # (first byte, where it ends) of each

    def __enter__(self) -> RecordFile:
        return self

    def __exit__(self, *_: Any) -> None:
        self.file.close()

    def tell(self) -> int:
        """Where the last whole record ends."""
        return self.records[-1][1]

    def write(self, record: bytes) -> int:
        if self.failure:
            raise self.failure
        left = memoryview(record)
        try:
            while left:
                left = left[self.file.write(left):]
        except OSError as error:
            self.failure = error
            self._cut(self.tell())
            raise
        if len(record):
            self.records.append((record[0], self.tell() + len(record)))
        return len(record)

    def flush(self) -> None:
        """Nothing waits here."""

    def sync(self) -> None:
        """Wait until all is on the disk."""
        os.fsync(self.file.fileno())

    def close_with(self, end: bytes) -> None:
        """Write `end` after the last record that leaves room for it; instead of an end of the same
        kind that is there already."""
        kinds = [kind for kind, _ in self.records]
        if end[0] in kinds:
            del self.records[kinds.index(end[0]):]
        while len(self.records) > 1:
            self.failure = None
            self._cut(self.tell())
            with suppress(OSError):
                self.write(end)
                self.sync()
                return
            self.records.pop()

    def _cut(self, size: int) -> None:
        self.file.truncate(size)
        self.file.seek(size)

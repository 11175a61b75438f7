"""Output file that contains only complete records, even if the disk becomes full."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any


class RecordFile:
    """Output stream of records. Use it as a context manager.

    Each write() writes one record. If a record does not fit on the disk, no part of it remains in
    the file, and this and all later calls raise OSError.
    """

    def __init__(self, path: Path):
        self.file = open(path, "wb", buffering=0)
        self.failure: OSError | None = None
        self.records = [(-1, 0)]  # (first byte, end offset) of each record

    def __enter__(self) -> RecordFile:
        return self

    def __exit__(self, *_: Any) -> None:
        self.file.close()

    def tell(self) -> int:
        """Return the end offset of the last complete record."""
        return self.records[-1][1]

    def write(self, record: bytes) -> int:
        if self.failure:
            raise self.failure
        remaining_bytes = memoryview(record)
        try:
            while remaining_bytes:
                remaining_bytes = remaining_bytes[self.file.write(remaining_bytes) :]
        except OSError as error:
            self.failure = error
            self._truncate(self.tell())
            raise
        if len(record):
            self.records.append((record[0], self.tell() + len(record)))
        return len(record)

    def flush(self) -> None:
        """Do nothing: writes are not buffered."""

    def sync(self) -> None:
        """Flush the file to disk."""
        os.fsync(self.file.fileno())

    def close_with(self, end: bytes) -> None:
        """Write a final record, removing as many of the last records as needed to make space.

        An existing final record of the same kind is replaced.
        """
        first_bytes = [first_byte for first_byte, _ in self.records]
        if end[0] in first_bytes:
            del self.records[first_bytes.index(end[0]) :]
        while len(self.records) > 1:
            self.failure = None
            self._truncate(self.tell())
            with suppress(OSError):
                self.write(end)
                self.sync()
                return
            self.records.pop()

    def _truncate(self, size: int) -> None:
        self.file.truncate(size)
        self.file.seek(size)

"""Logs of a training run: CSV files, and TensorBoard if it is installed."""

from __future__ import annotations

import csv
import io
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

from lidar_perception.runs.files import write_text
from lidar_perception.types import InputError


class Table:
    """CSV file with a column "step". The first row that is added determines the other columns."""

    def __init__(self, path: Path, step: int):
        """Open a table. Drop the rows after `step`, which a killed run wrote after its last save."""
        self.path, self.columns = path, None
        self.stream: TextIO | None = None
        rows = _read_rows(path)
        if rows:
            self.columns = rows[0]
            kept_rows = [row for row in rows[1:] if len(row) == len(rows[0]) and int(row[0]) <= step]
            text = io.StringIO()
            csv.writer(text, lineterminator="\n").writerows([rows[0], *kept_rows])
            write_text(path, text.getvalue())

    def add(self, step: int, values: dict[str, float]) -> None:
        """Append a row. Raise InputError if it cannot be written."""
        try:
            if self.stream is None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self.stream = open(self.path, "a", encoding="utf-8")
            writer = csv.writer(self.stream, lineterminator="\n")
            if self.columns is None:
                self.columns = ["step", *values]
                writer.writerow(self.columns)
            writer.writerow([step, *(_format_cell(values.get(name)) for name in self.columns[1:])])
            self.stream.flush()
        except OSError as error:
            raise InputError(f"cannot write {self.path}: {error.strerror}") from None

    def close(self) -> None:
        if self.stream is not None:
            with suppress(OSError):  # add() has already reported a full disk
                self.stream.close()


def _format_cell(value: Any) -> str:
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)


def _read_rows(path: Path) -> list[list[str]]:
    if not path.is_file():
        return []
    try:
        with open(path, newline="", encoding="utf-8") as stream:
            rows = list(csv.reader(stream))
        return [row for i, row in enumerate(rows) if i == 0 or (row and row[0].isdigit())]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"cannot read {path}: {error}; rename or remove it") from None


class Log:
    """Logs of a run in its folder: log.csv (losses), validation.csv (metrics) and TensorBoard events."""

    def __init__(self, folder: Path, step: int):
        self.tables = {"loss": Table(folder / "log.csv", step), "validation": Table(folder / "validation.csv", step)}
        self.board = None
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            return
        self.board = SummaryWriter(folder / "tensorboard", purge_step=step + 1 if step else None)

    def add(self, table: str, step: int, values: dict[str, float]) -> None:
        """Append a row to the table "loss" or "validation"."""
        self.tables[table].add(step, values)
        for name, value in values.items():
            if self.board is not None and value is not None:
                self.board.add_scalar(f"{table}/{name}", value, step)

    def close(self) -> None:
        for table in self.tables.values():
            table.close()
        if self.board is not None:
            self.board.close()

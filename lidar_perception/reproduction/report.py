"""The report of an experiment: HTML, Markdown, JSON, and a CSV file a table."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
import re
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as Grid
from rich.text import Text

from lidar_perception.reproduction.experiment import Cell, Experiment, Figure, Section, Table
from lidar_perception.reproduction.figures import draw
from lidar_perception.reproduction.report_files import REPORT
from lidar_perception.runs.files import write_bytes, write_text
from lidar_perception.runs.page import render_page, to_data_url

LEGEND = ("A figure, [its 95 % interval] from drawing the frames anew with replacement "
          "(bootstrap), and the paper's figure. An interval from a few frames, or from frames that "
          "all agree, is too narrow.")
MAX_ROWS = 30   # of a table that is open in the page
MAX_NAMES = 10  # of skipped frames for one reason


def write_report(out: Path, experiment: Experiment, records: list[dict[str, Any]],
                 sections: list[Section], about: dict[str, str]) -> Path:
    """Write report.html, .md and .json, tables/*.csv and figures/*.png into out; the path of the
    HTML page. about: what was run, name to text. InputError where something cannot be written."""
    counts = {"measured": sum("skipped" not in r for r in records)}
    counts["skipped"] = len(records) - counts["measured"]
    about = {"frames": f"{counts['measured']} measured, {counts['skipped']} skipped", **about}
    groups = skipped_groups(records)
    content = {"experiment": experiment.name, "title": experiment.title,
               "question": experiment.question, "about": about, **counts,
               "skipped_frames": [r for r in records if "skipped" in r], "sections": sections}
    write_text(out / REPORT, json.dumps(plain(content), indent=1, allow_nan=False))
    for table in (table for section in sections for table in section.tables):
        write_text(out / "tables" / f"{table.name}.csv", to_csv(table))
    for figure in (figure for section in sections for figure in section.figures):
        write_bytes(out / "figures" / f"{figure.name}.png", draw(figure, "png"))
    write_text(out / "report.md", to_markdown(experiment, sections, about, groups))
    write_text(out / "report.html", to_html(experiment, sections, about, groups))
    return out / "report.html"


def skipped_groups(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """count, reason (that of the first) and the first names of the frames that were skipped for
    the same reason up to numbers; most frames first."""
    groups: dict[str, list[dict]] = {}
    for record in records:
        if "skipped" in record:
            groups.setdefault(re.sub(r"\d+", "0", record["skipped"]), []).append(record)
    return [{"count": len(group), "reason": group[0]["skipped"],
             "names": [r["frame"] for r in group[:MAX_NAMES]]}
            for group in sorted(groups.values(), key=len, reverse=True)]


def parts(cell: Cell) -> tuple[str, str, str]:
    """A cell as it is shown: figure, interval and the paper's figure; "" where there is none."""
    value, low, high, paper = (None if number is None else f"{number:.{cell.digits}f}" for number
                               in (cell.value, cell.low, cell.high, cell.paper))
    return value or "–", f"[{low}, {high}]" if low and high else "", paper or ""


def is_number(cell: str | Cell) -> bool:
    """Whether a cell stands to the right, one digit below the other."""
    return isinstance(cell, Cell) or re.fullmatch(r"[-\d.]+", cell) is not None


def to_html(experiment: Experiment, sections: list[Section], about: dict[str, str],
            skipped: list[dict[str, Any]]) -> str:
    """One page that needs no other file."""
    def picture(figure: Figure, dark: bool) -> str:
        return to_data_url(draw(figure, "svg", dark=dark), "svg+xml")

    return render_page(
        "reproduction/report.html", title=experiment.title, question=experiment.question,
        about=about, skipped=skipped, sections=sections, legend=LEGEND, max_rows=MAX_ROWS,
        parts=parts, picture=picture, is_number=is_number)


def to_markdown(experiment: Experiment, sections: list[Section], about: dict[str, str],
                skipped: list[dict[str, Any]]) -> str:
    """The same in Markdown; pictures are files beside it."""
    lines = [f"# {experiment.title}", "", experiment.question, "",
             *_rows(("", ""), list(about.items())), ""]
    if skipped:
        lines += ["## Skipped frames", "", *_rows(
            ("frames", "why, for the first of them", "which"),
            [(str(g["count"]), g["reason"], ", ".join(g["names"])
              + (", ..." if g["count"] > len(g["names"]) else "")) for g in skipped]), ""]
    lines += [LEGEND, ""]
    for section in sections:
        lines += [f"## {section.title}", "", *([section.text, ""] if section.text else [])]
        for table in section.tables:
            lines += [f"**{table.title}**", "",
                      *_rows(table.header, [[_inline(cell) for cell in row] for row in table.rows]),
                      "", *([table.note, ""] if table.note else [])]
        for figure in section.figures:
            lines += [f"![{figure.title}](figures/{figure.name}.png)", ""]
    return "\n".join(lines)


def _rows(header, rows) -> list[str]:
    def line(row) -> str:
        return "| " + " | ".join(text.replace("|", r"\|") for text in row) + " |"
    return [line(header), "|" + "---|" * len(header), *map(line, rows)]


def _inline(cell: str | Cell) -> str:
    if isinstance(cell, str):
        return cell
    value, interval, paper = parts(cell)
    return " ".join(text for text in (value, interval, paper and f"(paper {paper})") if text)


def to_csv(table: Table) -> str:
    """Columns of figures become four: the figure, low, high and paper."""
    figures = [any(isinstance(row[i], Cell) for row in table.rows)
               for i in range(len(table.header))]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([name for i, title in enumerate(table.header) for name in (
        [title, *(f"{title} {end}" for end in ("low", "high", "paper"))] if figures[i]
        else [title])])
    for row in table.rows:
        writer.writerow([value for i, cell in enumerate(row) for value in (
            [cell.value, cell.low, cell.high, cell.paper] if isinstance(cell, Cell)
            else [cell, "", "", ""] if figures[i] else [cell])])
    return stream.getvalue()


def plain(value: Any) -> Any:
    """What JSON can hold: dataclasses as dicts, arrays and tuples as lists, NaN as None."""
    if dataclasses.is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, str | bool | int | float):
        return value
    return [plain(item) for item in value] if hasattr(value, "__iter__") else plain(value.item())


def print_report(sections: list[Section], skipped: list[dict[str, Any]], console: Console,
                 max_rows: int = 20) -> None:
    """The tables that fit on a screen, without intervals, and what was skipped."""
    for table in (table for section in sections for table in section.tables):
        if len(table.rows) <= max_rows:
            console.print(_grid(table))
    console.print("In brackets: the paper's. The report has the intervals.", style="dim")
    for group in skipped:
        console.print(Text("skipped", "yellow") + f" {group['count']}: {group['reason']}")


def _grid(table: Table) -> Grid:
    grid = Grid(title=table.title, title_justify="left", box=SIMPLE_HEAD,
                padding=(0, 1, 0, 0))
    for i, name in enumerate(table.header):
        right = i > 0 and all(is_number(row[i]) for row in table.rows)
        grid.add_column(name, justify="right" if right else "left", overflow="fold")
    for row in table.rows:
        grid.add_row(*map(_brief, row))
    return grid


def _brief(cell: str | Cell) -> str | Text:
    if isinstance(cell, str):
        return cell
    value, _, paper = parts(cell)
    return Text(f"{value} ") + Text(f"({paper})", "dim") if paper else value

"""Report of an experiment: HTML, Markdown, JSON, and one CSV file for each table."""

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

from experiments.framework.experiment import Cell, Experiment, Picture, Section, Table
from experiments.framework.figures import encode_figure, encode_png
from experiments.framework.report_files import REPORT
from lidar_perception.runs.files import write_bytes, write_text

LEGEND = (
    "Each cell has a value, [its 95 % interval] by a bootstrap over frames, and the paper's value. An "
    "interval from few frames, or from frames that all agree, is too narrow."
)
MAX_ROWS = 30  # longer tables are collapsed in the HTML page
MAX_NAMES = 10  # maximum number of frame names listed for one reason


def write_report(
    out: Path, experiment: Experiment, records: list[dict[str, Any]], sections: list[Section], run_info: dict[str, str]
) -> Path:
    """Write report.html, .md and .json, tables/*.csv and figures/*.png into out.

    Args:
        run_info: Facts about the run, such as the data and the machine, by name.

    Returns:
        The path of the HTML page.

    Raises:
        InputError: a file cannot be written.
    """
    counts = {"measured": sum("skipped" not in r for r in records)}
    counts["skipped"] = len(records) - counts["measured"]
    run_info = {"frames": f"{counts['measured']} measured, {counts['skipped']} skipped", **run_info}
    groups = group_skipped_frames(records)
    content = {
        "experiment": experiment.name,
        "title": experiment.title,
        "question": experiment.question,
        "about": run_info,
        **counts,
        "skipped_frames": [r for r in records if "skipped" in r],
        "sections": sections,
    }
    write_text(out / REPORT, json.dumps(to_json_data(content), indent=1, allow_nan=False))
    for table in (table for section in sections for table in section.tables):
        write_text(out / "tables" / f"{table.name}.csv", to_csv(table))
    for figure in (figure for section in sections for figure in section.figures):
        write_bytes(out / "figures" / f"{figure.name}.png", encode_png(figure))
    write_text(out / "report.md", to_markdown(experiment, sections, run_info, groups))
    write_text(out / "report.html", to_html(experiment, sections, run_info, groups))
    return out / "report.html"


def group_skipped_frames(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Group skipped frames whose reasons differ only in numbers, largest group first.

    Returns:
        For each group its count, the reason of its first frame, and the first MAX_NAMES names.
    """
    groups: dict[str, list[dict]] = {}
    for record in records:
        if "skipped" in record:
            groups.setdefault(re.sub(r"\d+", "0", record["skipped"]), []).append(record)
    return [
        {"count": len(group), "reason": group[0]["skipped"], "names": [r["frame"] for r in group[:MAX_NAMES]]}
        for group in sorted(groups.values(), key=len, reverse=True)
    ]


def format_cell(cell: Cell) -> tuple[str, str, str]:
    """Format the value, the interval and the paper's value of a cell. Unknown ones are empty."""
    value, low, high, paper = (
        None if number is None else f"{number:.{cell.digits}f}"
        for number in (cell.value, cell.low, cell.high, cell.paper)
    )
    return value or "–", f"[{low}, {high}]" if low and high else "", paper or ""


def is_number(cell: str | Cell) -> bool:
    """Return True for a cell with a number. Such cells are right-aligned."""
    return isinstance(cell, Cell) or re.fullmatch(r"[-\d.]+", cell) is not None


def to_html(
    experiment: Experiment, sections: list[Section], run_info: dict[str, str], skipped: list[dict[str, Any]]
) -> str:
    """Return the report as one self-contained HTML page."""
    import jinja2

    template = jinja2.Template(
        Path(__file__).with_name("report.html").read_text(encoding="utf-8"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
    )
    return template.render(
        title=experiment.title,
        question=experiment.question,
        about=run_info,
        skipped=skipped,
        sections=sections,
        legend=LEGEND,
        max_rows=MAX_ROWS,
        format_cell=format_cell,
        encode_figure=encode_figure,
        is_number=is_number,
    )


def to_markdown(
    experiment: Experiment, sections: list[Section], run_info: dict[str, str], skipped: list[dict[str, Any]]
) -> str:
    """Return the report in Markdown, with links to the figures."""
    lines = [f"# {experiment.title}", "", experiment.question, "", *_format_rows(("", ""), list(run_info.items())), ""]
    if skipped:
        lines += [
            "## Skipped frames",
            "",
            *_format_rows(
                ("frames", "reason of the first", "names"),
                [
                    (
                        str(g["count"]),
                        g["reason"],
                        ", ".join(g["names"]) + (", ..." if g["count"] > len(g["names"]) else ""),
                    )
                    for g in skipped
                ],
            ),
            "",
        ]
    lines += [LEGEND, ""]
    for section in sections:
        lines += [f"## {section.title}", "", *([section.text, ""] if section.text else [])]
        for table in section.tables:
            lines += [
                f"**{table.title}**",
                "",
                *_format_rows(table.header, [[_format_inline(cell) for cell in row] for row in table.rows]),
                "",
                *([table.note, ""] if table.note else []),
            ]
        for figure in section.figures:
            lines += [f"![{figure.title}](figures/{figure.name}.png)", ""]
    return "\n".join(lines)


def _format_rows(header, rows) -> list[str]:
    def format_row(row) -> str:
        return "| " + " | ".join(text.replace("|", r"\|") for text in row) + " |"

    return [format_row(header), "|" + "---|" * len(header), *map(format_row, rows)]


def _format_inline(cell: str | Cell) -> str:
    if isinstance(cell, str):
        return cell
    value, interval, paper = format_cell(cell)
    return " ".join(text for text in (value, interval, paper and f"(paper {paper})") if text)


def to_csv(table: Table) -> str:
    """Return a table as CSV. A column of values becomes four: value, low, high and paper."""
    has_values = [any(isinstance(row[i], Cell) for row in table.rows) for i in range(len(table.header))]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(
        [
            name
            for i, title in enumerate(table.header)
            for name in (
                [title, *(f"{title} {suffix}" for suffix in ("low", "high", "paper"))] if has_values[i] else [title]
            )
        ]
    )
    for row in table.rows:
        writer.writerow(
            [
                value
                for i, cell in enumerate(row)
                for value in (
                    [cell.value, cell.low, cell.high, cell.paper]
                    if isinstance(cell, Cell)
                    else [cell, "", "", ""]
                    if has_values[i]
                    else [cell]
                )
            ]
        )
    return stream.getvalue()


def to_json_data(value: Any) -> Any:
    """Convert dataclasses to dicts, arrays and tuples to lists, and NaN to None.

    The pixels of pictures are left out, because they are written as PNG files.
    """
    if isinstance(value, Picture):
        return {"name": value.name, "title": value.title}
    if dataclasses.is_dataclass(value):
        return {f.name: to_json_data(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {key: to_json_data(item) for key, item in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if hasattr(value, "__iter__"):
        return [to_json_data(item) for item in value]
    return to_json_data(value.item())


def print_report(sections: list[Section], skipped: list[dict[str, Any]], console: Console, max_rows: int = 20) -> None:
    """Print the tables that have at most max_rows rows, without intervals, and the skipped frames."""
    for table in (table for section in sections for table in section.tables):
        if len(table.rows) <= max_rows:
            console.print(_make_grid(table))
    console.print("Paper's values in brackets. See the report for intervals.", style="dim")
    for group in skipped:
        console.print(Text("skipped", "yellow") + f" {group['count']}: {group['reason']}")


def _make_grid(table: Table) -> Grid:
    grid = Grid(title=table.title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for i, name in enumerate(table.header):
        is_numeric = i > 0 and all(is_number(row[i]) for row in table.rows)
        grid.add_column(name, justify="right" if is_numeric else "left", overflow="fold")
    for row in table.rows:
        grid.add_row(*map(_format_brief, row))
    return grid


def _format_brief(cell: str | Cell) -> str | Text:
    if isinstance(cell, str):
        return cell
    value, _, paper = format_cell(cell)
    return Text(f"{value} ") + Text(f"({paper})", "dim") if paper else value

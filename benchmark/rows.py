"""Results of measurements, as dicts with rows for the printed table and the JSON file.

A row has the peer's `name`, `peer_ms` and `ours_ms`; a `value` with its `unit`; a `target`, if there is
one, and `met`; `same`, the number of frames with equal results; and `differ`, the number of points
that differ in the other frames.
"""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from lidar_perception.runs.terminal import console


def make_measurement(title: str, frames: int, points: float, rows: list[dict], **values) -> dict:
    return {"title": title, "frames": frames, "points": round(points), "rows": rows, **values}


def make_row(
    name: str,
    *,
    peer_ms: float | None = None,
    ours_ms: float | None = None,
    value: float | None = None,
    unit: str = "x",
    target: float | None = None,
    same: int | None = None,
    differ: int | None = None,
    note: str = "",
) -> dict:
    return add_target(
        dict(
            name=name,
            peer_ms=peer_ms,
            ours_ms=ours_ms,
            value=value,
            unit=unit,
            target=None,
            met=None,
            same=same,
            differ=differ,
            note=note,
        ),
        target,
    )


def add_target(content: dict, target: float | None) -> dict:
    """Return the row with a target, which is a minimum for the unit "x" (times faster), otherwise a maximum."""
    value, met = content["value"], None
    if target is not None and value is not None:
        met = value >= target if content["unit"] == "x" else value < target
    return {**content, "target": target, "met": met}


def compute_speedup(
    name: str, ms: dict[str, float], target: float | None = None, same: int | None = None, differ: int | None = None
) -> dict:
    """Return the row of a peer. Its value is how many times faster our implementation is."""
    return make_row(
        name, peer_ms=ms[name], ours_ms=ms["ours"], value=ms[name] / ms["ours"], target=target, same=same, differ=differ
    )


def format_value(value: float | None, unit: str) -> str:
    if value is None:
        return ""
    return {"x": f"{value:.1f}x", "": f"{value:.2f}"}.get(unit, f"{value:.0f} {unit}")


def format_target(target: float | None, unit: str) -> str:
    if target is None:
        return ""
    return f"{target:g}x" if unit == "x" else f"< {target:g} {unit}".rstrip()


def print_measured(content: dict) -> None:
    table = Table(title=f"{content['title']} ({content['frames']} frames, {content['points']} points)")
    for name in ("peer", "its ms", "our ms", "measured", "target", "met", "same"):
        table.add_column(name, justify="left" if name == "peer" else "right")
    for r in content["rows"]:
        met = "" if r["met"] is None else "yes" if r["met"] else Text("no", "red")
        table.add_row(
            r["name"],
            _format_ms(r["peer_ms"]),
            _format_ms(r["ours_ms"]),
            r["note"] or format_value(r["value"], r["unit"]),
            format_target(r["target"], r["unit"]),
            met,
            "" if r["same"] is None else f"{r['same']} of {content['frames']}",
        )
    console.print(table)
    for r in content["rows"]:
        if r["differ"]:
            console.print(f"{r['name']}: {r['differ']} points have different labels")


def print_ground(content: dict) -> None:
    """Print the ground methods by protocol."""
    table = Table(title=f"Ground on {content['scans']} labelled scans (SemanticKITTI)")
    for name in ("method", "precision", "recall", "F1", "ms"):
        table.add_column(name, justify="left" if name == "method" else "right")
    for protocol in content["protocols"]:
        table.add_section()
        table.add_row(protocol, style="bold")
        for method, report in content["methods"].items():
            cells = [report.get("note", "")]
            if "protocols" in report:
                scores = report["protocols"][protocol]
                cells = [f"{scores[k]:.4f}" for k in ("precision", "recall", "f1")]
                cells.append(_format_ms(report["ms"]))
            table.add_row(method, *cells)
    console.print(table)


def _format_ms(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}" if value < 100 else f"{value:.0f}"

"""Figures of the report, drawn with Matplotlib."""

from __future__ import annotations

import base64
from io import BytesIO
from typing import Any

from experiments.framework.experiment import Figure, Line, Picture

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # palette of Okabe and Ito, 2008
GREY = "#888888"
MAX_COLUMNS = 3  # maximum number of panels side by side


def encode_figure(figure: Figure | Picture) -> str:
    """Return a figure as a data URL for the HTML page."""
    kind, content = (
        ("png", _encode_picture(figure)) if isinstance(figure, Picture) else ("svg+xml", draw_figure(figure, "svg"))
    )
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def encode_png(figure: Figure | Picture) -> bytes:
    """Return a figure as PNG."""
    return _encode_picture(figure) if isinstance(figure, Picture) else draw_figure(figure, "png")


def _encode_picture(picture: Picture) -> bytes:
    from PIL import Image

    stream = BytesIO()
    Image.fromarray(picture.pixels).save(stream, format="png")
    return stream.getvalue()


def draw_figure(figure: Figure, kind: str = "svg") -> bytes:
    """Draw a figure as svg or png: panels side by side, with one legend.

    Equal figures give equal bytes.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    style: Any = {
        "axes.edgecolor": GREY,
        "grid.color": "#e3e3e3",
        "font.size": 9,
        "legend.frameon": False,
        "svg.hashsalt": figure.name,
    }
    with matplotlib.rc_context(style):
        columns = min(MAX_COLUMNS, len(figure.panels))
        rows = -(-len(figure.panels) // columns)
        legend_at_right = columns == 1  # a single panel leaves room for the legend
        size = (8.0, 3.4) if legend_at_right else (3.7 * columns, 2.9 * rows + 0.5)
        canvas = Canvas(figsize=size, dpi=130, layout="constrained")
        FigureCanvasAgg(canvas)
        axes = canvas.subplots(rows, columns, squeeze=False).ravel()
        handles: dict[str, Any] = {}
        for panel, axis in zip(figure.panels, axes):
            for line, color in zip(panel.lines, _choose_colors(panel.lines)):
                handles.setdefault(line.label, _plot_line(axis, line, color))
            axis.set(title=panel.title, xlabel=panel.x_label, ylabel=panel.y_label)
            if "%" in panel.y_label:
                axis.set_ylim(0, 102)
            axis.grid(linewidth=0.6)
            axis.spines[["top", "right"]].set_visible(False)
        for axis in axes[len(figure.panels) :]:
            axis.set_visible(False)
        canvas.legend(
            handles.values(),
            handles.keys(),
            ncols=1 if legend_at_right else 2 * columns,
            loc="outside right upper" if legend_at_right else "outside lower center",
        )
        stream = BytesIO()
        metadata = {"Date": None} if kind == "svg" else {}
        canvas.savefig(stream, format=kind, metadata=metadata)
    return stream.getvalue()


def _choose_colors(lines: tuple[Line, ...]) -> list[str]:
    """Return a colour for each line. A dashed line "a, paper" gets the colour of the line "a"."""
    solid_labels = [line.label for line in lines if not line.dashed]
    color_by_label = {label: COLORS[i % len(COLORS)] for i, label in enumerate(solid_labels)}
    return [
        next((color for label, color in color_by_label.items() if line.label.startswith(label)), GREY) for line in lines
    ]


def _plot_line(axes, line: Line, color: str):
    x, y, low, high = (
        [float("nan") if v is None else v for v in values] for values in (line.x, line.y, line.low, line.high)
    )
    if len(low) and len(high):
        axes.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)
    style = dict(linestyle="--", marker="D", markerfacecolor="none") if line.dashed else dict(marker="o", markersize=3)
    if line.dashed and len(x) == 2 and x[0] == x[1]:
        style["marker"] = ""  # a vertical line marks a value on the x axis
    return axes.plot(x, y, color=color, linewidth=1.4, **style)[0]

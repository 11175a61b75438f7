"""Tables and a picture of the comparison of simulated and real scans."""

from __future__ import annotations

import math
from pathlib import Path

from rich.console import Console

from experiments.realism.compare import MIN_SAMPLES, compute_factor
from experiments.realism.scan_statistics import CURVES
from lidar_perception.scoring.pictures import save_picture
from lidar_perception.scoring.tables import format_number, make_table, print_skipped

MAX_WORST_BINS = 25
REAL_COLOR, SIMULATED_COLOR, WRONG_COLOR = "#0072b2", "#d55e00", "#b00000"
PANELS_PER_ROW = 5


def print_realism(content: dict, console: Console) -> None:
    """Print the numbers of scans, the curves, the worst bins and a summary."""
    for side in ("real", "simulated"):
        row = content[side]
        objects = ", ".join(f"{count} {name}" for name, count in row["objects"].items())
        console.print(
            f"{side}: {row['scans']} scans, {row['whole_scans']} of them full revolutions; "
            f"{objects}; {row['pedestrian_frames']} scans with a pedestrian"
        )
    _print_curves(content, console)
    _print_worst(content, console)
    print_skipped(content["real"]["skipped"] + content["simulated"]["skipped"], console)
    console.print(format_summary(content), style="bold")


def format_summary(content: dict) -> str:
    """Return a line with the numbers of right and of plausible bins."""
    return (
        f"{content['within']} of {content['judged']} bins are within 20 % of the real median, "
        f"{content['plausible']} within 20 % or within its 95 % interval"
    )


def find_typical_factor(curve: dict) -> float | None:
    """Return the median factor of the judged bins; None if there are none."""
    factors = sorted(compute_factor(b) for b in curve["bins"] if b["within"] is not None)
    return factors[len(factors) // 2] if factors else None


def _print_curves(content: dict, console: Console) -> None:
    table = make_table(
        "Simulated against real, worst curves first", "curve", "within 20 %", "typical", "worst at", "ratio"
    )
    judged_curves = [c for c in content["curves"].values() if c["judged"]]
    for curve in sorted(judged_curves, key=lambda c: (c["share"], -(find_typical_factor(c) or 0.0))):
        worst = max((b for b in curve["bins"] if b["within"] is not None), key=compute_factor)
        table.add_row(
            _format_title(curve),
            f"{curve['within']} of {curve['judged']}",
            format_number(find_typical_factor(curve), width=9),
            worst["bin"],
            format_number(worst["ratio"], width=9),
        )
    unjudged_count = sum(
        not curve["judged"] and not CURVES[name].histogram for name, curve in content["curves"].items()
    )
    table.caption = (
        "typical: the median factor between simulated and real. ratio: simulated / "
        f"real at the worst bin. {unjudged_count} curves have no bin with {MIN_SAMPLES} "
        "real samples."
    )
    console.print(table)


def _print_worst(content: dict, console: Console) -> None:
    bins = [(curve, b) for curve in content["curves"].values() for b in curve["bins"] if b["within"] is False]
    table = make_table(
        f"The {min(MAX_WORST_BINS, len(bins))} worst of {len(bins)} bins that are not within 20 %",
        "curve",
        "bin",
        "real",
        "10..90 %",
        "n",
        "sim.",
        "10..90 %",
        "n",
        "ratio",
    )
    for curve, b in sorted(bins, key=lambda item: -compute_factor(item[1]))[:MAX_WORST_BINS]:
        table.add_row(
            _format_title(curve),
            b["bin"],
            *(cell for side in ("real", "simulated") for cell in _format_cells(b[side])),
            format_number(b["ratio"], width=9),
        )
    table.caption = "Median and 10 to 90 % range of n scans or objects."
    if bins:
        console.print(table)


def _format_title(curve: dict) -> str:
    suffix = " by elevation" if curve["axis"].startswith("elevation") else ""
    return curve["title"].removesuffix(" [m]") + suffix


def _format_cells(side: dict) -> list[str]:
    limits = [_format_value(side[key]) for key in ("low", "high") if side[key] is not None]
    return [_format_value(side["median"]), "..".join(limits), str(side["n"])]


def _format_value(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}" if value >= 100 else f"{value:.2g}"


def draw_realism(path: Path, content: dict) -> None:
    """Write a PNG of all curves, with medians and 10 to 90 % ranges.

    Raises:
        InputError: The file cannot be written.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.patches import Patch

    rows = math.ceil(len(content["curves"]) / PANELS_PER_ROW)
    size = (4.4 * PANELS_PER_ROW, 3.0 * rows)
    figure, grid = plt.subplots(rows, PANELS_PER_ROW, figsize=size, dpi=100, squeeze=False, layout="constrained")
    for axes, (name, curve) in zip(grid.flat, content["curves"].items()):
        if CURVES[name].histogram:
            _draw_histogram(axes, curve)
        else:
            _draw_curve(axes, curve, CURVES[name].log_scale)
    for axes in grid.flat[len(content["curves"]) :]:
        axes.set_visible(False)
    handles = [
        Patch(color=REAL_COLOR, label="real"),
        Patch(color=SIMULATED_COLOR, label="simulated"),
        Patch(color="#eeeeee", label=f"fewer than {MIN_SAMPLES} real samples"),
        Patch(color=WRONG_COLOR, label="red title: most bins are wrong"),
    ]
    figure.legend(handles=handles, loc="outside lower right", ncols=4, fontsize=13)
    figure.suptitle(
        f"{format_summary(content)}; {content['real']['scans']} real "
        f"scans, {content['simulated']['scans']} simulated\nmedian and 10 to 90 % range of "
        "the scans or objects; [bins within 20 % / judged bins]",
        x=0.01,
        ha="left",
        fontsize=15,
    )
    save_picture(path, figure)


def _draw_curve(axes, curve: dict, log_scale: bool) -> None:
    """Draw one panel. Bins with too few real samples to be judged are grey."""
    positions = range(len(curve["bins"]))
    for side, color, shift in (("real", REAL_COLOR, -0.08), ("simulated", SIMULATED_COLOR, 0.08)):
        median, low, high = (_get_column(curve, side, key) for key in ("median", "low", "high"))
        x = [position + shift for position in positions]
        line_length = len(x) - (curve["bins"][-1]["bin"] == "all")  # the line ends before the bin `all`
        axes.plot(x[:line_length], median[:line_length], color=color, linewidth=1.6)
        axes.plot(x, median, "o", color=color, markersize=4)
        spread = [[max(m - a, 0) for m, a in zip(median, low)], [max(b - m, 0) for m, b in zip(median, high)]]
        axes.errorbar(x, median, spread, fmt="none", ecolor=color, elinewidth=1, alpha=0.6, capsize=2)
    for i in positions:
        if curve["bins"][i]["within"] is None:
            axes.axvspan(i - 0.5, i + 0.5, color="#eeeeee", linewidth=0)
    if log_scale:
        axes.set_yscale("symlog", linthresh=10)
    axes.set_xticks(
        positions,
        [b["bin"] for b in curve["bins"]],
        fontsize=8,
        rotation=60 if len(positions) > 9 else 30 if len(positions) > 6 else 0,
    )
    axes.set_xlim(-0.5, len(positions) - 0.5)
    verdict = f"{curve['within']}/{curve['judged']}" if curve["judged"] else "not judged"
    is_wrong = curve["judged"] and curve["share"] < 0.5
    _label_axes(axes, curve, f"{curve['title']}  [{verdict}]", WRONG_COLOR if is_wrong else "black")


def _draw_histogram(axes, curve: dict) -> None:
    """Draw one panel. Each bar starts at the tick of its bin."""
    positions = range(len(curve["bins"]))
    for side, color, alpha in (("real", REAL_COLOR, 0.5), ("simulated", SIMULATED_COLOR, 0.35)):
        fractions = _get_column(curve, side, "median")
        axes.bar(positions, fractions, width=1.0, align="edge", color=color, alpha=alpha, linewidth=0)
        axes.step([*positions, len(positions)], [*fractions, fractions[-1]], where="post", color=color)
    axes.set_xticks(positions[::4], [b["bin"] for b in curve["bins"]][::4], fontsize=8)
    _label_axes(axes, curve, curve["title"], "black")


def _label_axes(axes, curve: dict, title: str, color: str) -> None:
    axes.set_ylim(bottom=0)
    axes.set_xlabel(curve["axis"], fontsize=9)
    axes.tick_params(axis="y", labelsize=8)
    axes.grid(color="#dddddd", linewidth=0.5, axis="y")
    axes.set_title(title, fontsize=10.5, color=color)


def _get_column(curve: dict, side: str, key: str) -> list[float]:
    return [math.nan if b[side][key] is None else b[side][key] for b in curve["bins"]]

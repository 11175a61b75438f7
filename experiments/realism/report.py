"""Tables of the comparison of simulated and real scans."""

from __future__ import annotations

from rich.console import Console

from experiments.realism.compare import MIN_SAMPLES, compute_factor
from lidar_perception.scoring.tables import format_number, make_table, print_skipped

MAX_WORST_BINS = 25


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
        worst_bin = max((b for b in curve["bins"] if b["within"] is not None), key=compute_factor)
        table.add_row(
            _format_title(curve),
            f"{curve['within']} of {curve['judged']}",
            format_number(find_typical_factor(curve), width=9),
            worst_bin["bin"],
            format_number(worst_bin["ratio"], width=9),
        )
    unjudged_count = sum(not curve["judged"] for curve in content["curves"].values())
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

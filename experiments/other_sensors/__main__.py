"""python -m experiments.other_sensors: count true positives, false positives and misses by data set."""

from __future__ import annotations

from pathlib import Path

import click

from experiments.other_sensors.counts import MAX_DISTANCE_M, Counts, count_all, read_clouds
from experiments.other_sensors.kitti import CHANGES, evaluate_kitti
from lidar_perception.cli.command import Command
from lidar_perception.detectors.open import open_detector
from lidar_perception.types import InputError


@click.command(cls=Command, context_settings=dict(help_option_names=["-h", "--help"]))
@click.argument("data", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--weights", default="", help="Weights or file of `train fused`. Default: the default detector.")
@click.option("--min-score", type=float, help="One threshold for all classes. Default: the detector's.")
@click.option(
    "--kitti",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    help="Also evaluate KITTI object frames, with changed intensity.",
)
def main(data: Path, weights: str, min_score: float | None, kitti: Path | None) -> None:
    """Count true positives / false positives / misses in DATA/DATASET/*.npz, with and without intensity.

    \b
    Example:
      python -m experiments.other_sensors ../shared/data/other_sensors \\
          --kitti ../shared/data/kitti_object
    """
    detector = open_detector(weights or "fused", "cpu").with_range("around")
    if min_score is not None:
        detector = detector.with_min_score(min_score)
    clouds = list(read_clouds(data))
    for with_intensity in (True, False):
        sums = count_all(detector, clouds, with_intensity)
        click.echo("as recorded" if with_intensity else "without intensity")
        for dataset in sorted({dataset for dataset, _ in sums}):
            cells = (_format_cell(name, sums.get((dataset, name))) for name in MAX_DISTANCE_M)
            click.echo(f"  {dataset:14}" + "".join(cells))
        totals = {
            name: sum((counts for (_, class_name), counts in sums.items() if class_name == name), Counts())
            for name in MAX_DISTANCE_M
        }
        cells = (f"{_format_cell(name, counts)} F1 {counts.f1:4.1f}" for name, counts in totals.items())
        click.echo("  all           " + "".join(cells))
    if kitti is None:
        return
    for title, change in CHANGES.items():
        scores = evaluate_kitti(open_detector(weights or "fused", "cpu"), kitti, change)
        click.echo(f"KITTI, intensity {title}: " + ", ".join(f"{name} {value:.1f}" for name, value in scores.items()))


def _format_cell(name: str, counts: Counts | None) -> str:
    text = "" if counts is None else f"{counts.tp} / {counts.fp} / {counts.fn}"
    return f"  {name} {text:16}"


if __name__ == "__main__":
    try:
        main(prog_name="experiments.other_sensors")
    except InputError as error:
        click.echo(f"Error: {error}", err=True)
        raise SystemExit(2) from None

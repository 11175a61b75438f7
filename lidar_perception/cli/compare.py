"""compare: every detector of the package on the same frames."""

from __future__ import annotations

import json
import platform
from itertools import islice
from pathlib import Path

import click

from lidar_perception.runs.files import write_text
from lidar_perception.runs.terminal import console, errors, track
from lidar_perception.types import InputError


@click.command()
@click.option("--kitti", type=click.Path(path_type=Path), metavar="ROOT", required=True,
              help="KITTI folder with labels: 3D object, tracking or raw, or a simulated one.")
@click.option("--weights", type=click.Path(path_type=Path), metavar="FILE", multiple=True,
              help="One more network, PointPillars or PointNet; may be given several times.")
@click.option("--frames", "most", type=click.IntRange(1), metavar="N",
              help="The first N frames only.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), metavar="FILE",
              help="Write the scores to this file.")
@click.option("--png", type=click.Path(path_type=Path), metavar="FILE",
              help="Draw F1 and mean AP against time.")
@click.option("--device", default="auto", help="Where networks run: auto, cpu, cuda. Default: "
              "auto.")
def compare(kitti: Path, weights: tuple[Path, ...], most: int | None, json_file: Path | None,
            png: Path | None, device: str) -> None:
    """Run all detectors on the same frames, in turns, and print scores and times side by side.

    STM-CPA (`paper` and `best`), PointPillars V0 to V4 in both sizes, PointNet, and their hybrids:
    average precision, F1 of pedestrians by centre distance as in the STM-CPA paper, ms a frame.
    Networks without weights are listed as missing.

    \b
    Examples:
      lidar-perception compare --kitti /data/kitti/object --json compare.json --png compare.png
      lidar-perception compare --kitti training_data --weights v4.safetensors --frames 100
    """
    from lidar_perception.data.kitti.folder import open_kitti
    from lidar_perception.runs.machine import cpu_name
    from lidar_perception.scoring.comparison.contenders import contenders
    from lidar_perception.scoring.comparison.outcomes import Outcome, objects
    from lidar_perception.scoring.comparison.outcomes import compare as compared
    from lidar_perception.scoring.comparison.report import draw_comparison, print_comparison
    from lidar_perception.scoring.kitti.tables import CENTRE_F1

    frames = open_kitti(kitti)
    with errors.status("loading detectors"):
        found, missing = contenders(weights, device)
    outcomes, skipped = [Outcome(each) for each in found], []
    work = compared(frames, outcomes, skipped)
    for _ in track(work if most is None else islice(work, most), "comparing",
                   len(frames) if most is None else min(most, len(frames))):
        pass
    first = outcomes[0].report
    if not first.frames:
        reason = f" ({skipped[0]})" if skipped else ""
        raise InputError(f"{kitti}: no frame with labels{reason}")
    centres = first.pedestrians.content()
    content = {
        "source": str(kitti), "machine": cpu_name(), "device": device,
        "python": platform.python_version(), "frames": len(first.frames),
        "objects": objects(outcomes[0]),
        "pedestrians": {key: centres[key] for key in ("frames", "ground_truth")},
        "rows": {each.contender.name: each.content() for each in outcomes},
        "missing": [vars(each) for each in missing], "paper_f1": CENTRE_F1, "skipped": skipped}
    if json_file:
        write_text(json_file, json.dumps(content, indent=1))
    print_comparison(content, console)
    if png is not None:
        draw_comparison(png, content)
        console.print(f"figure: {png}")

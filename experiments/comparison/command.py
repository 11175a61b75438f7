"""Command compare: run every detector of the package on the same frames."""

from __future__ import annotations

import platform
from functools import partial
from pathlib import Path

import click

from lidar_perception.cli.command import Command
from lidar_perception.cli.data import (
    ScoringOptions,
    intervals_option,
    make_no_labels_error,
    path_option,
    scoring_options,
)
from lidar_perception.cli.options import (
    Algorithm,
    Settings,
    device_option,
    make_candidate_algorithm,
    make_detector_algorithm,
    range_option,
    settings_options,
)
from lidar_perception.detectors.open import PARAMS
from lidar_perception.runs.terminal import console, errors


def _list_algorithms() -> list[Algorithm]:
    """List the algorithms that have parameters."""
    return [make_candidate_algorithm(), *map(make_detector_algorithm, PARAMS)]


@click.command(cls=Command)
@scoring_options()
@path_option(
    "--weights",
    "Additional detector: weights of PointPillars or PointNet, or your own class, module:Class. May be repeated.",
    multiple=True,
)
@intervals_option
@range_option
@device_option
@settings_options(lambda options: _list_algorithms(), candidates=True)
def compare(
    options: ScoringOptions, weights: tuple[Path, ...], range: str, device: str, settings: Settings, intervals: int
) -> None:
    """Run all detectors on the same frames, in rotating order, and print scores and times side by side.

    The detectors are STM-CPA (`paper` and `best`), PointPillars V0 to V4 in both sizes, PointNet
    and fused (the default detector). The tables show average precision, F1 of pedestrians by
    centre distance as in the STM-CPA paper, and ms per frame. Networks without weights are listed
    as missing. With several --jobs the processes share the machine, so times are longer.

    \b
    Examples:
      ./lidar compare /data/kitti/object --json compare.json
      ./lidar compare /data/kitti/tracking --intervals 200
      ./lidar compare training_data --weights v4.safetensors --limit 100
    """
    from experiments.comparison.contenders import open_available_contenders, open_contenders
    from experiments.comparison.outcomes import ComparisonReport, start_comparison
    from experiments.comparison.report import print_comparison
    from lidar_perception.data.frame import BOXES
    from lidar_perception.runs.machine import read_cpu_name
    from lidar_perception.scoring.kitti.tables import CENTRE_F1

    algorithms = _list_algorithms() if settings else []
    values = {
        algorithm.name: param_values for algorithm, param_values in zip(algorithms, settings.resolve(*algorithms))
    }
    recording = options.open_recording(BOXES)
    with errors.status("loading detectors"):
        height = recording.frames[0].sensor_height
        contenders, missing = open_contenders(weights, device, height, range, values)
    open_function = (
        (lambda: contenders)
        if options.in_this_process
        else partial(open_available_contenders, weights, device, height, range, values)
    )
    report = ComparisonReport(contenders, intervals, recording.is_sequential)
    options.fill(report, recording, partial(start_comparison, open_function), title="comparing")
    if not report.first.frames:
        raise make_no_labels_error(recording, report.skipped)
    centres = report.first.pedestrians.compute()
    content = {
        "source": str(options.data),
        "machine": read_cpu_name(),
        "device": device,
        "python": platform.python_version(),
        **report.compute(),
        "pedestrians": {key: centres[key] for key in ("frames", "ground_truth")},
        "missing": [vars(detector) for detector in missing],
        "paper_f1": CENTRE_F1,
    }
    print_comparison(content, console)
    options.write(content)

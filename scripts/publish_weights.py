"""Add trained weights to the package, stored as float16 and with a model card.

    lidar-perception simulate --format kitti --frames 500 --seed 9000 --out simulated
    python scripts/publish_weights.py v4/best.safetensors simulated /data/kitti/object
    python scripts/publish_weights.py v4/best.safetensors --mean-with before.safetensors simulated
    python scripts/publish_weights.py --card pointnet.safetensors /data/kitti/object

The card lists training data, classes, range, sensor, scores with intervals on each folder, known
failures and the licence. The folders must not have been used for training.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click

from lidar_perception.data.open import open_recording
from lidar_perception.detectors import checkpoint
from lidar_perception.detectors.checkpoint import POINTNET, read_header, require_same_config, save_checkpoint
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.params import MIN_SCORE
from lidar_perception.detectors.pointnet.network import load_pointnet
from lidar_perception.detectors.pointpillars.network import load_network
from lidar_perception.detectors.weights_file import CLASSIFIER, POINTNET_WEIGHTS, POINTPILLARS_WEIGHTS
from lidar_perception.runs.files import write_text
from lidar_perception.runs.terminal import console
from lidar_perception.scoring.detections import measure_detector
from lidar_perception.scoring.intervals import INTERVAL_PERCENT
from lidar_perception.scoring.kitti.report import DetectionReport
from lidar_perception.scoring.run import fill_report
from lidar_perception.training.record import round_metrics, select_metrics

ROWS = (("bev_relaxed", "BEV"), ("bev", "BEV"), ("3d_relaxed", "3D"), ("3d", "3D"))
EARLY_SENSOR = {"name": "hdl64e", "beams": 64, "height": 1.73}  # sensor of weights whose header names none
SAMPLES = 200  # bootstrap samples of the intervals
SENSOR_FAILURES = [
    "Other sensors: many people are missed if the beams are sparser than in training.",
    "Clouds without intensity: fewer people are found.",
]
FAILURES = {  # network -> known failures
    "pointpillars": [
        *SENSOR_FAILURES,
        "False people: thin objects beyond 36 m, round signs on posts, posts with reflectors.",
        "Boxes of real cars are about 0.1 m too far away and 0.1 m too long (median).",
    ],
    POINTNET: [*SENSOR_FAILURES, "Missed: people in one cluster with walls or other people, far cyclists."],
}
CLASSIFIER_NOTE = (
    "Use: classifies the boxes that PointPillars proposes in `fused`. Alone, `pointnet` finds real cars better."
)


def evaluate_weights(weights: Path, folder: Path) -> dict[str, Any]:
    """Return the results of `evaluate detection --intervals`, as in its JSON file."""
    recording = open_recording(folder)
    report = DetectionReport(sequential=recording.is_sequential)
    fill_report(
        report, recording, partial(measure_detector, partial(open_detector, weights, min_score=MIN_SCORE), 1.0, None)
    )
    return {**report.compute(), "intervals": report.compute_intervals(SAMPLES)}


def format_card(header: checkpoint.Header, title: str, results: dict[str, dict[str, Any]]) -> str:
    """Return the model card as Markdown."""
    lines = [f"# {title}", "", *(f"- {line}" for line in describe_weights(header, title)), ""]
    for name, content in results.items():
        lines += format_figures(name, content, header.config.classes)
    lines += [
        "## Known failures",
        "",
        *(f"- {line}" for line in FAILURES[header.network]),
        "",
        "## Licence",
        "",
        "Apache-2.0, as the package.",
        "",
    ]
    return "\n".join(lines)


def describe_weights(header: checkpoint.Header, title: str) -> list[str]:
    """Return lines about the network, its training data, range and sensor."""
    training, config = header.training, header.config
    low, high = getattr(config, "low", None), getattr(config, "high", None)
    sensor = training.get("sensor", EARLY_SENSOR)  # empty for scans of several sensors
    init, validation_scenes = training.get("init"), training["validation_scenes"]
    if init:
        init = (
            "earlier shipped weights"
            if "package" in init
            else ("/".join(Path(init).parts[-2:]) if init.startswith("/") else init)
        )
    start = f", starting from {init}" if init else ""
    return [
        f"Network: {header.network} {config.title}".rstrip() + "; the header of the file has the full config.",
        *([CLASSIFIER_NOTE] if title == Path(CLASSIFIER).stem else []),
        f"Training data: {', '.join(training['data'])}, {training['scenes']} scenes; "
        + (f"validation on {validation_scenes} others." if validation_scenes else "no validation.")
        + (" Simulated streets only, no real scan." if training["data"] == ["sim"] else ""),
        f"Training: {training['steps']} steps of {training['batch']} scenes in "
        f"{training['seconds'] / 60:.0f} minutes, seed {training['seed']}{start}.",
        *(
            f"Mean of these and earlier weights ({earlier['steps']} steps, commit {earlier['commit']})."
            for earlier in training.get("mean_with", ())
        ),
        f"Commit: {header.commit}.",
        f"Classes: {', '.join(config.classes)}.",
        "Range: all clusters of the cloud."
        if low is None or high is None
        else f"Range: x {low[0]:g} to {high[0]:g} m, y {low[1]:g} to {high[1]:g} m. `range: around` "
        "covers 51.2 m in all directions.",
        f"Sensor: {sensor['name']}, {sensor['beams']} beams, {sensor['height']} m above the ground."
        if sensor
        else "Sensor: several, which the header does not list.",
        "Scores: calibrated probabilities." if header.calibration else "Scores: not calibrated.",
        "Stored as float16.",
    ]


def format_figures(name: str, content: dict[str, Any], classes: tuple[str, ...]) -> list[str]:
    """Return the section of the card about one data set, as lines of Markdown."""
    lines = [
        f"## {name}: {content['frames']} frames",
        "",
        f"AP in percent (R40, moderate), with the {INTERVAL_PERCENT} % interval of {SAMPLES} "
        "bootstrap samples where it is computed, and the number of labels in brackets.",
        "",
        "| | overlap | " + " | ".join(classes) + " |",
        "|---|---|" + "---|" * len(classes),
    ]
    for row, metric in ROWS:
        cells, overlaps = [], []
        for class_name in classes:
            class_result = content["ap"][class_name][row]
            overlaps.append(f"{class_result['overlap']:g}")
            value, bounds = class_result["moderate"], content["intervals"][class_name].get(row)
            interval = f", {bounds[0]:.0f} to {bounds[1]:.0f}" if bounds else ""
            cells.append(f"{value['r40']:.1f}{interval} ({value['objects']})" if value else "-")
        lines.append(f"| {metric} | {' / '.join(overlaps)} | {' | '.join(cells)} |")
    centres = content["pedestrian_centres"]
    total = centres["at_best_score"]["all"]
    return [
        *lines,
        "",
        f"Pedestrians within 1.0 m, at the best threshold "
        f"({centres['best_score'] or 0:.2f}): F1 {100 * total['f1']:.1f} (TP {total['tp']}, FP "
        f"{total['fp']}, FN {total['fn']}).",
        "",
    ]


@click.command()
@click.argument("weights", type=click.Path(exists=True, path_type=Path))
@click.argument("folders", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option(
    "--mean-with",
    "second_path",
    type=click.Path(exists=True, path_type=Path),
    help="Store the mean of both, weight by weight (Wortsman et al., CVPR 2022).",
)
@click.option("--judge", is_flag=True, help="A PointNet for `fused`, not to be used alone.")
@click.option("--card", is_flag=True, help="Only score WEIGHTS and write the model card next to them.")
def main(weights: Path, folders: tuple[Path, ...], second_path: Path | None, judge: bool, card: bool) -> None:
    """Score, store and describe one checkpoint."""
    if card:
        content = {folder.name: evaluate_weights(weights, folder) for folder in folders}
        write_text(weights.with_suffix(".md"), format_card(read_header(weights), weights.stem, content))
        return
    load = load_pointnet if read_header(weights).network == POINTNET else load_network
    header, network = load(weights)
    if second_path is not None:
        second_header, second_network = load(second_path)
        require_same_config(header.config, second_header.config, str(second_path))
        state = second_network.state_dict()
        network.load_state_dict(
            {
                name: (value + state[name]) / 2 if value.is_floating_point() else value
                for name, value in network.state_dict().items()
            }
        )
        header = replace(
            header,
            training={
                **header.training,
                "mean_with": [{"steps": second_header.training["steps"], "commit": second_header.commit}],
            },
        )
    if header.network == POINTNET:
        out = POINTNET_WEIGHTS.with_name(CLASSIFIER) if judge else POINTNET_WEIGHTS
    else:
        out = POINTPILLARS_WEIGHTS / f"pointpillars_{header.config.version}_{header.config.size}.safetensors"
    out.parent.mkdir(exist_ok=True)
    save_checkpoint(out, network, header, half=True)
    results = {folder.name: evaluate_weights(out, folder) for folder in folders}
    if second_path is not None:  # the header has the metrics of the mean on the first folder
        metrics = select_metrics(results[folders[0].name], "bev", header.config.classes)
        save_checkpoint(out, network, replace(header, metrics=round_metrics(metrics)), half=True)
    write_text(out.with_suffix(".md"), format_card(header, out.stem, results))
    console.print(f"{out}: {out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()

"""Add trained weights to the package, as float16 and with a model card.

    lidar-perception simulate --format kitti --frames 500 --seed 9000 --out simulated
    python scripts/publish_weights.py v4/best.safetensors simulated /data/kitti/object
    python scripts/publish_weights.py v4/best.safetensors --mean-with before.safetensors simulated

The card has the training data and the scores on each folder, none of which may have been used for
training.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click

from lidar_perception.data.open import open_recording
from lidar_perception.detectors import checkpoint
from lidar_perception.detectors.checkpoint import (
    POINTNET,
    read_network_name,
    require_same_config,
    save_checkpoint,
)
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.params import MIN_SCORE
from lidar_perception.detectors.pointnet.network import load_pointnet
from lidar_perception.detectors.pointnet.weights_file import JUDGE
from lidar_perception.detectors.pointnet.weights_file import WEIGHTS as POINTNET_WEIGHTS
from lidar_perception.detectors.pointpillars.network import load_network
from lidar_perception.detectors.pointpillars.weights_file import WEIGHTS
from lidar_perception.runs.files import write_text
from lidar_perception.runs.terminal import console
from lidar_perception.scoring.detections import measure_detector
from lidar_perception.scoring.kitti.report import DetectionReport
from lidar_perception.scoring.run import fill
from lidar_perception.training.record import round_metrics, select_metrics

ROWS = (("bev_relaxed", "from above"), ("bev", "from above"), ("3d_relaxed", "in space"),
        ("3d", "in space"))


def evaluate_weights(weights: Path, folder: Path) -> dict[str, Any]:
    """Return the results of `evaluate detection` as JSON data."""
    report = DetectionReport()
    open_ = partial(open_detector, weights, min_score=MIN_SCORE)
    fill(report, open_recording(folder), measure_detector(open_))
    return report.compute()


def format_card(header: checkpoint.Header, title: str, scored: dict[str, dict[str, Any]]) -> str:
    """Return the model card as Markdown."""
    training = header.training
    init = training.get("init")
    start = f", begun with {Path(init).parent.name}/{Path(init).name}" if init else ""
    lines = [
        f"# {title}", "",
        f"- Network: {header.network}, {' '.join(header.config.classes)}; every field of its "
        "config is in the file's header.",
        f"- Trained on: {', '.join(training['data'])}, {training['scenes']} scenes; validated on "
        f"{training['validation_scenes']} others."
        + (" No real scan was trained on." if training["data"] == ["sim"] else ""),
        f"- Steps: {training['steps']} of {training['batch']} scenes, "
        f"{training['seconds'] / 60:.0f} minutes, seed {training['seed']}{start}.",
        f"- Commit: {header.commit}.",
        *(f"- The mean of these weights and of earlier ones, {other['steps']} steps at commit "
          f"{other['commit']}." for other in training.get("mean_with", ())),
        "- Stored as float16.", ""]
    for name, content in scored.items():
        lines += [f"## {name}: {content['frames']} frames", "",
                  "AP in percent at 40 recall points, moderate; labels in brackets.", "",
                  "| | overlap | " + " | ".join(header.config.classes) + " |",
                  "|---|---|" + "---|" * len(header.config.classes)]
        for row, words in ROWS:
            cells, overlaps = [], []
            for kind in header.config.classes:
                part = content["ap"][kind][row]
                overlaps.append(f"{part['overlap']:g}")
                value = part["moderate"]
                cells.append(f"{value['r40']:.1f} ({value['objects']})" if value else "-")
            lines.append(f"| {words} | {' / '.join(overlaps)} | {' | '.join(cells)} |")
        centres = content["pedestrian_centres"]
        total = centres["at_best_score"]["all"]
        lines += ["", f"Pedestrians within 1.0 m, score {centres['best_score'] or 0:.2f} and more "
                  f"(where F1 is greatest): F1 {100 * total['f1']:.1f} (TP {total['tp']}, FP "
                  f"{total['fp']}, FN {total['fn']})."]
        lines.append("")
    return "\n".join(lines)


@click.command()
@click.argument("weights", type=click.Path(exists=True, path_type=Path))
@click.argument("folders", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--mean-with", "before", type=click.Path(exists=True, path_type=Path),
              help="Store the mean of both, weight by weight (Wortsman et al., CVPR 2022).")
@click.option("--judge", is_flag=True, help="A PointNet for `fused`, not to be used alone.")
def main(weights: Path, folders: tuple[Path, ...], before: Path | None, judge: bool) -> None:
    """Score, store and describe one checkpoint."""
    load = load_pointnet if read_network_name(weights) == POINTNET else load_network
    header, network = load(weights)
    if before is not None:
        earlier, other = load(before)
        require_same_config(header.config, earlier.config, str(before))
        state = other.state_dict()
        network.load_state_dict({
            name: (value + state[name]) / 2 if value.is_floating_point() else value
            for name, value in network.state_dict().items()})
        header = replace(header, training={**header.training, "mean_with": [
            {"steps": earlier.training["steps"], "commit": earlier.commit}]})
    if header.network == POINTNET:
        out = POINTNET_WEIGHTS.with_name(JUDGE) if judge else POINTNET_WEIGHTS
    else:
        out = WEIGHTS / f"pointpillars_{header.config.version}_{header.config.size}.safetensors"
    out.parent.mkdir(exist_ok=True)
    save_checkpoint(out, network, header, half=True)
    scored = {folder.name: evaluate_weights(out, folder) for folder in folders}
    if before is not None:  # the header has the metrics of the mean on the first folder
        metrics = select_metrics(scored[folders[0].name], "bev", header.config.classes)
        save_checkpoint(out, network, replace(header, metrics=round_metrics(metrics)), half=True)
    write_text(out.with_suffix(".md"), format_card(header, out.stem, scored))
    console.print(f"{out}: {out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()

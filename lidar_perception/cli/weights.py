"""import-weights and export: import networks of other projects, and export to other runtimes."""

from __future__ import annotations

from pathlib import Path

import click

from lidar_perception.cli.command import Command, Group
from lidar_perception.cli.data import out_file_option
from lidar_perception.runs.terminal import console


@click.command("import-weights", cls=Command)
@click.argument("source", type=click.Path(path_type=Path), metavar="FILE.pth")
@out_file_option("--out", "Checkpoint to write (.safetensors).", required=True)
@click.option(
    "--classes",
    metavar="A,B,C",
    default="",
    help="Classes in the order used for training. Default: the project's order for KITTI.",
)
@click.option("--half", is_flag=True, help="Store the weights of layers as float16.")
def import_weights(source: Path, out: Path, classes: str, half: bool) -> None:
    """Convert PointPillars weights of OpenPCDet or mmdetection3d (1.x) to a checkpoint.

    Supports networks for KITTI with pillars of 0.16 m. The file is loaded as weights only; no code
    in it is run. The conventions for anchors, headings and points of a pillar are converted.

    \b
    Examples:
      lidar-perception import-weights pointpillar_7728.pth --out pointpillars.safetensors
      lidar-perception import-weights car.pth --classes Car --out car.safetensors
    """
    from lidar_perception.detectors.checkpoint import Header, save_checkpoint
    from lidar_perception.detectors.pointpillars.import_weights import import_weights as convert_weights

    names = tuple(name.strip() for name in classes.split(",") if name.strip())
    config, network, project = convert_weights(source, names)
    save_checkpoint(out, network, Header(config, {"imported from": project, "file": source.name}), half)
    console.print(f"{out}: PointPillars of {project} for {', '.join(config.classes)}")


@click.group(cls=Group)
def export() -> None:
    """Export a network for another runtime."""


@export.command()
@click.argument("weights", type=click.Path(path_type=Path), metavar="WEIGHTS")
@out_file_option("--out", "File to write (.onnx).", required=True)
def onnx(weights: Path, out: Path) -> None:
    """Write a checkpoint of PointPillars or PointNet as ONNX (needs the extra [onnx]).

    Any version, size and classes can be exported. The graph of PointPillars takes points sorted
    into pillars and returns the raw outputs at every anchor; that of PointNet takes the points of
    clusters. The metadata contains the configuration. Detectors accept the file as a checkpoint.

    \b
    Examples:
      lidar-perception export onnx v4.safetensors --out v4.onnx
      lidar-perception export onnx pointnet/best.safetensors --out pointnet.onnx
    """
    from lidar_perception.detectors.checkpoint import POINTNET, read_header

    if read_header(weights).network == POINTNET:
        from lidar_perception.detectors.pointnet import onnx as pointnet
        from lidar_perception.detectors.pointnet.network import load_pointnet

        header, classifier = load_pointnet(weights)
        pointnet.export_onnx(classifier, header, out)
        title = f"PointNet {header.config.name}"
    else:
        from lidar_perception.detectors.pointpillars import onnx as pointpillars
        from lidar_perception.detectors.pointpillars.network import load_network

        header, network = load_network(weights)
        pointpillars.export_onnx(network.eval(), header, out)
        title = f"{header.config.version} {header.config.size}"
    console.print(f"{out}: {title} for {', '.join(header.config.classes)}")

"""run: nodes where `ros2 run` is not installed."""

from __future__ import annotations

import sys

import click

from lidar_perception.nodes import NODES
from lidar_perception.nodes.main import run


@click.command(context_settings=dict(ignore_unknown_options=True, allow_interspersed_args=False))
@click.argument("node", type=click.Choice(list(NODES)))
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def run_node(node: str, arguments: tuple[str, ...]) -> None:
    """Start one ROS NODE; what follows goes to it, as with `ros2 run lidar_perception NODE`.

    \b
    Example:
      lidar-perception run bag_player --ros-args -p bag:=drive.bag -p rate:=0.5
    """
    sys.exit(run(node, [node, *arguments]))

"""run: start a node where `ros2 run` is not installed."""

from __future__ import annotations

import os
import sys

import click

from lidar_perception.cli.command import Choice, Command
from lidar_perception.nodes import NODES


@click.command(cls=Command, context_settings=dict(ignore_unknown_options=True, allow_interspersed_args=False))
@click.argument("node", type=Choice(NODES), metavar="NODE")
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def run_node(node: str, arguments: tuple[str, ...]) -> None:
    """Start one ROS NODE with the remaining arguments, like `ros2 run lidar_perception NODE`.

    \b
    Example:
      lidar-perception run bag_player --ros-args -p bag:=drive.bag -p rate:=0.5
    """
    # Replaces this process: some of its threads do not block signals, so a signal would end it at once.
    os.execv(sys.executable, [sys.executable, "-P", "-m", "lidar_perception.nodes.main", node, *arguments])

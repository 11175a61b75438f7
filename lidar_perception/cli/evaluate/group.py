"""evaluate: the group of the commands that score algorithms without ROS."""

from __future__ import annotations

import click

from lidar_perception.cli.command import Group
from lidar_perception.cli.evaluate.candidates import candidates
from lidar_perception.cli.evaluate.clusters import clusters
from lidar_perception.cli.evaluate.detection import detection
from lidar_perception.cli.evaluate.nuscenes import nuscenes
from lidar_perception.cli.evaluate.segmentation import segmentation
from lidar_perception.cli.evaluate.tracking import tracking


@click.group(cls=Group)
def evaluate() -> None:
    """Score the algorithms without ROS."""


for command in candidates, clusters, detection, nuscenes, segmentation, tracking:
    evaluate.add_command(command)

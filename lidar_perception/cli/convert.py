"""convert: data sets to bags."""

from __future__ import annotations

from pathlib import Path

import click

from lidar_perception.data.kitti.folder import open_kitti
from lidar_perception.data.to_bag import kitti_scan, write_bag
from lidar_perception.runs.terminal import console, track
from lidar_perception.types import InputError


@click.group()
def convert() -> None:
    """Turn a data set into a rosbag2 bag."""


@convert.command()
@click.argument("root", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Bag folder to make.")
@click.option("--images", is_flag=True, help="Include the left colour images, as PNG.")
@click.option("--frames", type=click.IntRange(1), help="Only the first N frames.")
@click.option("--force", is_flag=True, help="Replace the bag if it exists.")
def kitti(root: Path, out: Path, images: bool, frames: int | None, force: bool) -> None:
    """KITTI 3D object, tracking or raw data at ROOT to one MCAP bag.

    Topics: /points, /ground_truth/detections, /camera/camera_info, /camera/extrinsics, /tf_static,
    and with --images /camera/image/compressed. Scans that cannot be read are left out, named and
    counted; the exit code is then 1.

    \b
    Example:
      lidar-perception convert kitti /data/kitti/tracking --out tracking.bag
    """
    wanted = open_kitti(root)[:frames]
    skipped: list[str] = []

    def scans():
        for frame in track(wanted, f"converting {root}", len(wanted)):
            try:
                scan = kitti_scan(frame, images)
            except InputError as error:
                skipped.append(str(error))
                continue
            yield scan

    count = write_bag(out, scans(), force=force)
    console.print(f"{out}: {count} scans of {len(wanted)}")
    for line in skipped:
        console.print(f"[yellow]left out[/]: {line}")
    raise SystemExit(1 if skipped else 0)

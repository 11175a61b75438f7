"""convert: labelled frames to a bag."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import click
from rich.markup import escape

from lidar_perception.cli.data import limit_option, opened, split_option
from lidar_perception.runs.terminal import console, track


@click.command()
@click.argument("data", type=click.Path(path_type=Path), metavar="PATH")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Bag folder to make.")
@click.option("--images", is_flag=True, help="Include the left colour images, as PNG.")
@split_option
@limit_option
@click.option("--force", is_flag=True, help="Replace the bag if it exists.")
def convert(data: Path, out: Path, images: bool, split: Path | None, limit: int | None,
            force: bool) -> None:
    """KITTI, nuScenes or SemanticKITTI at PATH, or another bag, to one MCAP bag.

    Topics: /points, /ground_truth/detections, /camera/camera_info, /camera/extrinsics, /tf_static,
    and with --images /camera/image/compressed. Scans that cannot be read are left out, named and
    counted; the exit code is then 1.

    \b
    Examples:
      lidar-perception convert /data/kitti/tracking --out tracking.bag
      lidar-perception convert /data/nuscenes/v1.0-mini --out nuscenes.bag
    """
    from lidar_perception.data.to_bag import write_bag
    recording = opened(data, split=split)
    count = min(len(recording), limit or len(recording))
    skipped: list[str] = []
    frames = track(islice(recording, count), f"converting {data}", count)
    written = write_bag(out, frames, images=images, force=force, skipped=skipped)
    console.print(f"{out}: {written} scans of {count}")
    for line in skipped:
        console.print(f"[yellow]left out[/]: {escape(line)}")
    raise SystemExit(1 if skipped else 0)

"""view: look at results on a page in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from lidar_perception.cli.data import browser_option, device_option, opened, port_option
from lidar_perception.runs.terminal import console
from lidar_perception.types import InputError

if TYPE_CHECKING:
    from lidar_perception.labeling.server import Served


@click.command()
@click.argument("path", type=click.Path(path_type=Path))
@click.option("--weights", multiple=True, metavar="FILE|NAME", help="Run the detector of this "
              "checkpoint, or one by its name: fused, pointpillars or pointnet. May be given "
              "several times.")
@click.option("--results", multiple=True, type=click.Path(path_type=Path), metavar="FOLDER",
              help="KITTI result files, FOLDER/NAME.txt. May be given several times.")
@click.option("--points", metavar="TOPIC", help="Topic of the clouds of a bag. Default: clustered "
              "ones, else /points, else the only one there.")
@click.option("--sequence", metavar="NAME", help="The drive of PATH to show, where it has "
              "several.")
@device_option
@port_option
@browser_option
@click.option("--screenshot", type=click.Path(path_type=Path), metavar="PNG", help="Write a "
              "picture of the page and end; needs chromium.")
@click.option("--frame", type=click.IntRange(0), default=0, show_default=True, metavar="N",
              help="Frame to begin with.")
@click.option("--theme", type=click.Choice(["auto", "light", "dark"]), default="auto",
              show_default=True, help="Of the page.")
def view(path: Path, weights: tuple[str, ...], results: tuple[Path, ...], points: str | None,
         sequence: str | None, device: str, port: int, browser: bool, screenshot: Path | None,
         frame: int, theme: str) -> None:
    """Look at a recording and its results on a page in the browser: clouds with ground and
    clusters, labels, detections by source and score, what is missed and false, tracks. PATH is a
    bag, such as the result bag of the demo, or the folder of a data set.

    \b
    Examples:
      lidar-perception view out/demo/result
      lidar-perception view /data/kitti/tracking --weights fused
      lidar-perception view /data/kitti/object --results labels --screenshot frame.png --frame 12
    """
    import asyncio
    import webbrowser

    from lidar_perception.labeling.picture import screenshot_of
    from lidar_perception.labeling.server import serve

    served = _served(path, weights, results, points, sequence, device)
    if frame >= len(served.drive.frames):
        raise InputError(f"{path} has no frame {frame}; it has {len(served.drive.frames)}")

    def started(url: str) -> None:
        url += f"&frame={frame}&theme={theme}"
        console.print(url, soft_wrap=True, markup=False)
        if screenshot is None and browser:
            webbrowser.open(url)
    if screenshot is None:
        asyncio.run(serve(served, port, started))
    else:
        asyncio.run(screenshot_of(served, screenshot, f"frame={frame}&theme={theme}"))
        console.print(f"{screenshot}", markup=False)


def _served(path: Path, weights: tuple[str, ...], results: tuple[Path, ...], points: str | None,
            sequence: str | None, device: str) -> Served:
    """What the page shows of a path."""
    from lidar_perception.data.bag_frames import recognises
    from lidar_perception.detectors.open import open_detector
    from lidar_perception.labeling import results as shown
    from lidar_perception.labeling.drive import one_drive
    from lidar_perception.labeling.server import Served

    a_bag = path.exists() and recognises(path)
    recording = opened(path, points=points or shown.points_topic(path)) if a_bag else opened(path)
    drive = one_drive(recording, sequence)
    found = shown.Results()
    if a_bag:
        drive = shown.with_recorded_scans(drive)
        found = shown.recorded(path, [f.stamp_ns for f in drive.frames])
    height = drive.frames[0].sensor_height
    more = {Path(name).stem: shown.by_detector(open_detector(name, device, sensor_height=height))
            for name in weights}
    more |= {folder.name: shown.by_files(folder) for folder in results}
    found = shown.Results({**found.sources, **more}, found.tracks)
    return Served(drive, layers=found.layers_of(drive), tracks=found.tracks)

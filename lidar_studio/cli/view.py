"""view: look at results on a page in the browser."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from lidar_perception.cli.command import Choice, Command
from lidar_perception.cli.data import browser_option, data_argument, opened, port_option
from lidar_perception.cli.options import detectors_options
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.runs.terminal import console, show_scanning
from lidar_perception.types import InputError

if TYPE_CHECKING:
    from lidar_studio.served import Served

WEIGHTS = (".safetensors", ".onnx", ".json")


@click.command(cls=Command)
@data_argument(required=False)
@click.option("--live", is_flag=True, help="Look at the running graph instead of a recording.")
@detectors_options
@click.option("--results", multiple=True, type=click.Path(path_type=Path), metavar="FOLDER",
              help="KITTI result files, FOLDER/NAME.txt, such as `detect --format kitti "
              "--out FOLDER` writes. May be given several times.")
@click.option("--points", "--topic", "points", metavar="TOPIC", help="Topic of the clouds of a bag "
              "or of the running graph. Default: clustered ones, else /points, else the only one "
              "there.")
@click.option("--detections", multiple=True, metavar="TOPIC", help="With --live: a topic of boxes, "
              "MarkerArray or Detection3DArray. Default: all */output/detections that go with the "
              "clouds. May be given several times.")
@click.option("--namespace", default="", metavar="NAME", help="With --live: follow the nodes in "
              "this namespace, / for those in none, where several graphs run.")
@click.option("--sequence", metavar="NAME", help="The drive of DATA to show, where it has "
              "several.")
@port_option
@browser_option
@click.option("--screenshot", type=click.Path(path_type=Path), metavar="PNG", help="Write a "
              "picture of the page and end; needs chromium.")
@click.option("--frame", type=click.IntRange(0), default=0, show_default=True, metavar="N",
              help="Frame to begin with.")
@click.option("--theme", type=Choice(["auto", "light", "dark"]), default="auto",
              show_default=True, help="Colours of the page.")
def view(data: Path | None, live: bool, detectors: tuple[DetectorChoice, ...],
         results: tuple[Path, ...], points: str | None, detections: tuple[str, ...],
         namespace: str, sequence: str | None, port: int, browser: bool, screenshot: Path | None,
         frame: int, theme: str) -> None:
    """Look at a recording and its results on a page in the browser: clouds with ground and
    clusters, labels, detections by source and score, missed and false ones, tracks. DATA is a
    bag, such as the result bag of the demo, or the folder of a data set; --live shows the nodes
    that run on this ROS_DOMAIN_ID, the newest frame first.

    \b
    Examples:
      lidar-perception view out/demo/result
      lidar-perception view /data/kitti/tracking --sequence 0000 --weights fused
      lidar-perception view drive.bag --weights fused
      lidar-perception view /data/kitti/object --results out/data --screenshot frame.png --frame 12
      lidar-perception view --live --namespace front
    """
    import asyncio
    import webbrowser

    from lidar_studio.picture import screenshot_of
    from lidar_studio.server import serve

    if (data is None) != live:
        raise click.UsageError("give DATA, the path of a recording, or --live")
    only = {"--weights": detectors, "--results": results, "--sequence": sequence,
            "--screenshot": screenshot} if live else {"--detections": detections,
                                                      "--namespace": namespace}
    if given := [name for name, value in only.items() if value]:
        raise click.UsageError(f"{', '.join(given)}: {'not with' if live else 'only with'} --live")

    def started(url: str) -> None:
        url += f"&frame={frame}&theme={theme}"
        console.print(url)
        if screenshot is None and browser:
            webbrowser.open(url)
    if data is None:
        with _listening(namespace, points or "", detections) as served:
            asyncio.run(serve(served, port, started))
        return
    served = _served(data, detectors, results, points, sequence)
    if frame >= served.drive.end:
        raise InputError(f"{data} has no frame {frame}; it has {served.drive.end}")
    if screenshot is None:
        asyncio.run(serve(served, port, started))
    else:
        asyncio.run(screenshot_of(served, screenshot, f"frame={frame}&theme={theme}"))
        console.print(f"{screenshot}")


@contextmanager
def _listening(namespace: str, points: str, detections: tuple[str, ...]) -> Iterator[Served]:
    """What the page shows of the running graph, while the block lasts."""
    from lidar_perception.nodes import require_rclpy
    from lidar_perception.nodes.shared_memory import is_fed_by_driver, use_large_shared_memory
    from lidar_studio.live import Live
    from lidar_studio.served import Served

    require_rclpy()
    use_large_shared_memory(points != "" and is_fed_by_driver([points]))
    from lidar_studio.live_view import listening  # with the profile already set
    name = "/".join(filter(None, (f"ROS domain {os.environ.get('ROS_DOMAIN_ID') or 0}",
                                  namespace.strip("/"))))
    live = Live(name)
    with listening(live, None, namespace, points, detections):
        yield Served(live, layers=live.layers, tracks=live.tracks)


def _served(path: Path, detectors: tuple[DetectorChoice, ...], results: tuple[Path, ...],
            points: str | None, sequence: str | None) -> Served:
    """What the page shows of a path."""
    from lidar_perception.data.bag_frames import is_layout
    from lidar_perception.data.open import split_topic
    from lidar_studio import results as shown
    from lidar_studio.drive import one_drive, require_clouds
    from lidar_studio.served import Served

    path, named = split_topic(path)
    a_bag = path.exists() and is_layout(path)
    recording = (opened(path, points=points or named or shown.points_topic(path)) if a_bag
                 else opened(path))
    with show_scanning(path):
        drive = one_drive(recording, sequence)
    require_clouds(drive)
    found = shown.Results()
    if a_bag:
        drive = shown.with_recorded_scans(drive)
        found = shown.recorded(recording.frames.poses, [f.stamp_ns for f in drive.frames])
    height = drive.frames[0].sensor_height
    made = {Path(each.weights): shown.by_detector(each.open(sensor_height=height))
            for each in detectors}
    made |= {folder.absolute(): shown.by_files(folder) for folder in results}
    more = zip(short_names(list(made), found.sources), made.values())
    found = shown.Results({**found.sources, **dict(more)}, found.tracks)
    return Served(drive, layers=found.layers_of(drive), tracks=lambda: found.tracks)


def short_names(paths: list[Path], taken: Collection[str] = ()) -> list[str]:
    """A name for each of several files or folders: the end of its path, as much of it as tells it
    from the others and from the names that are taken; all of it where nothing else does."""
    parts = [path.with_suffix("").parts if path.suffix in WEIGHTS else path.parts for path in paths]
    names = []
    for i, own in enumerate(parts):
        ends = (own[-k:] for k in range(1, len(own) + 1))
        others = [each for j, each in enumerate(parts) if j != i]
        names.append(next(("/".join(end) for end in ends if "/".join(end) not in taken and all(
            other[-len(end):] != end for other in others)), str(paths[i])))
    return names

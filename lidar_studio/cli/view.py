"""The view command: serve the page that shows recordings, results and running graphs."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from lidar_perception.cli.command import Choice, Command
from lidar_perception.cli.data import browser_option, data_argument, open_and_describe, port_option
from lidar_perception.cli.options import detectors_options
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.runs.terminal import console, show_scanning
from lidar_perception.types import InputError

if TYPE_CHECKING:
    from lidar_studio.server import PageContent

WEIGHTS_SUFFIXES = (".safetensors", ".onnx", ".json")


@click.command(cls=Command)
@data_argument(required=False)
@click.option("--live", is_flag=True, help="Show the running graph instead of a recording.")
@detectors_options
@click.option(
    "--results",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Show the KITTI result files FOLDER/NAME.txt, for example the output of "
    "`detect --format kitti --out FOLDER`. May be given several times.",
)
@click.option(
    "--points",
    "--topic",
    "points",
    metavar="TOPIC",
    help="Topic of the clouds in a bag or in the running graph. "
    "Default: clouds with clusters, otherwise /points, otherwise the only cloud topic.",
)
@click.option(
    "--detections",
    multiple=True,
    metavar="TOPIC",
    help="With --live: topic with boxes (MarkerArray or Detection3DArray). "
    "Default: all */output/detections that belong to the clouds. May be given several times.",
)
@click.option(
    "--namespace",
    default="",
    metavar="NAME",
    help="With --live: namespace of the nodes to show if several graphs are running; / for nodes without a namespace.",
)
@click.option("--sequence", metavar="NAME", help="Drive to show if DATA contains several.")
@port_option
@browser_option
@click.option("--frame", type=click.IntRange(0), default=0, show_default=True, metavar="N", help="First frame to show.")
@click.option(
    "--theme",
    type=Choice(["auto", "light", "dark"]),
    default="auto",
    show_default=True,
    help="Colour theme of the page.",
)
def view(
    data: Path | None,
    live: bool,
    detectors: tuple[DetectorChoice, ...],
    results: tuple[Path, ...],
    points: str | None,
    detections: tuple[str, ...],
    namespace: str,
    sequence: str | None,
    port: int,
    browser: bool,
    frame: int,
    theme: str,
) -> None:
    """Show a recording and its results on a page in the browser: clouds with ground and
    clusters, labels, tracks, detections by source and score, misses and false positives. DATA is a
    bag, such as the result bag of the demo, or the folder of a data set. With --live, the page shows
    the newest frames of the nodes that run on this ROS_DOMAIN_ID.

    \b
    Examples:
      lidar-perception view out/demo/result
      lidar-perception view /data/kitti/tracking --sequence 0000 --weights fused
      lidar-perception view drive.bag --weights fused
      lidar-perception view /data/kitti/object --results out/data --frame 12
      lidar-perception view --live --namespace front
    """
    import asyncio
    import webbrowser

    from lidar_studio.server import serve

    if (data is None) != live:
        raise click.UsageError("specify either DATA (the path of a recording) or --live")
    incompatible_options = (
        {"--weights": detectors, "--results": results, "--sequence": sequence}
        if live
        else {"--detections": detections, "--namespace": namespace}
    )
    if names := ", ".join(name for name, value in incompatible_options.items() if value):
        raise click.UsageError(
            f"{names} cannot be used with --live" if live else f"{names} can only be used with --live"
        )

    def on_start(url: str) -> None:
        url += f"&frame={frame}&theme={theme}"
        console.print(url)
        if browser:
            webbrowser.open(url)

    if data is None:
        with _open_live_content(namespace, points or "", detections) as content:
            asyncio.run(serve(content, port, on_start))
        return
    content = _open_content(data, detectors, results, points, sequence)
    if frame >= content.drive.end:
        raise InputError(
            f"{data} has only {content.drive.end} frames (0 to {content.drive.end - 1}), so no frame {frame}"
        )
    asyncio.run(serve(content, port, on_start))


@contextmanager
def _open_live_content(namespace: str, points: str, detections: tuple[str, ...]) -> Iterator[PageContent]:
    from lidar_perception.nodes import require_rclpy
    from lidar_perception.nodes.shared_memory import reads_driver_clouds, use_large_shared_memory
    from lidar_studio.live_graph import LiveGraph
    from lidar_studio.server import PageContent

    require_rclpy()
    use_large_shared_memory(points != "" and reads_driver_clouds([points]))
    from lidar_studio.live_view import run_live_view  # imports rclpy, which must see the DDS profile set above

    name = "/".join(filter(None, (f"ROS domain {os.environ.get('ROS_DOMAIN_ID') or 0}", namespace.strip("/"))))
    live = LiveGraph(name)
    with run_live_view(live, None, namespace, points, detections):
        yield PageContent(live, make_layers=live.make_layers, list_tracks=live.list_tracks)


def _open_content(
    path: Path,
    detectors: tuple[DetectorChoice, ...],
    results: tuple[Path, ...],
    points: str | None,
    sequence: str | None,
) -> PageContent:
    from lidar_perception.data.bag_frames import can_open
    from lidar_perception.data.open import split_topic
    from lidar_studio import results as result_sources
    from lidar_studio.drive import require_clouds, select_drive
    from lidar_studio.server import PageContent

    path, topic = split_topic(path)
    is_bag = path.exists() and can_open(path)
    if is_bag:
        points = points or topic or result_sources.choose_points_topic(path)
        recording = open_and_describe(path, points=points)
    else:
        recording = open_and_describe(path)
    with show_scanning(path):
        drive = select_drive(recording, sequence)
    require_clouds(drive)
    shown_results = result_sources.Results()
    if is_bag:
        drive = replace(drive, make_scan=result_sources.read_recorded_scan)
        shown_results = result_sources.read_recorded_results(recording.frames.poses, [f.stamp_ns for f in drive.frames])
    height = drive.frames[0].sensor_height
    sources = {
        Path(choice.weights): result_sources.make_detector_source(choice.open(sensor_height=height))
        for choice in detectors
    }
    sources |= {folder.absolute(): result_sources.make_file_source(folder) for folder in results}
    names = make_short_names(list(sources), shown_results.sources)
    shown_results = result_sources.Results(
        {**shown_results.sources, **dict(zip(names, sources.values()))}, shown_results.tracks
    )
    return PageContent(drive, make_layers=shown_results.bind_layers(drive), list_tracks=lambda: shown_results.tracks)


def make_short_names(paths: list[Path], used_names: Collection[str] = ()) -> list[str]:
    """Return a unique short name for each path.

    The name is the shortest suffix of the path that is neither a suffix of another path nor in
    `used_names`, otherwise the full path.
    """
    parts = [path.with_suffix("").parts if path.suffix in WEIGHTS_SUFFIXES else path.parts for path in paths]
    names = []
    for i, path_parts in enumerate(parts):
        suffixes = (path_parts[-k:] for k in range(1, len(path_parts) + 1))
        others = [other for j, other in enumerate(parts) if j != i]
        names.append(
            next(
                (
                    "/".join(suffix)
                    for suffix in suffixes
                    if "/".join(suffix) not in used_names and all(other[-len(suffix) :] != suffix for other in others)
                ),
                str(paths[i]),
            )
        )
    return names

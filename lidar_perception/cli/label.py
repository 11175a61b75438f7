"""label: a drive's labels, made by a person on a page in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lidar_perception.cli.data import a_path, data_option, opened, weights_option
from lidar_perception.runs.terminal import console, errors

if TYPE_CHECKING:
    from lidar_perception.labeling.drive import Drive


@click.command()
@data_option
@click.option("--sequence", metavar="NAME", help="The drive of PATH to label, where it has "
              "several.")
@a_path("--out", "Folder of the journal, with which it is gone on. Default: out/label/NAME OF THE "
        "DRIVE.", "FOLDER")
@click.option("--port", type=click.IntRange(0, 65535), default=0, show_default=True,
              help="Port on 127.0.0.1; 0: any that is free.")
@click.option("--open/--no-open", "browser", default=True, help="Open the page in a browser.  "
              "[default: open]")
@weights_option
@click.option("--propose/--no-propose", default=True, help="Look for proposals in the whole drive "
              "at once, unless the journal has some.  [default: propose]")
@click.option("--show-labels", is_flag=True, help="Show the labels that the drive has.")
def label(data: Path, sequence: str | None, out: Path | None, port: int, browser: bool,
          weights: Path | None, propose: bool, show_labels: bool) -> None:
    """Label a drive on a page in the browser: click, accept, correct.

    Everything is kept at once in FOLDER/journal.jsonl; ctrl-C ends.

    \b
    Examples:
      lidar-perception label --data /data/kitti/tracking
      lidar-perception label --data drive --out labels --no-open --port 8080
    """
    import asyncio
    import webbrowser

    from lidar_perception.detectors.open import FUSED
    from lidar_perception.labeling.drive import one_drive
    from lidar_perception.labeling.exchange import FORMATS
    from lidar_perception.labeling.server import Served, serve
    from lidar_perception.labeling.session import session

    drive = one_drive(opened(data), sequence)
    folder = out or Path("out/label") / drive.name
    with session(drive, folder, str(weights or FUSED)) as made:
        if made.journal.message:
            errors.print(made.journal.message, style="yellow", soft_wrap=True, markup=False)

        def started(url: str) -> None:
            console.print(url, soft_wrap=True, markup=False)
            errors.print(f"journal: {made.journal.path}; ctrl-C ends", soft_wrap=True,
                         markup=False, style="dim")
            if propose and not made.was_proposed:
                made.do({"do": "propose"})
            if browser:
                webbrowser.open(url)
        served = Served(drive, made, _labels(drive) if show_labels else None,
                        can_export=tuple(FORMATS), export=made.export)
        asyncio.run(serve(served, port, started))


def _labels(drive: Drive) -> Any:
    """The labels of frame i, as the page has them."""
    def layers(i: int, score: float) -> dict[str, Any]:
        truth = drive.frames[i].truth()
        labels = [] if truth is None else [
            [*box.tolist(), name, extra.get("track_id")]
            for box, name, extra in zip(truth.boxes, truth.labels, truth.extras)]
        return {"labels": labels, "detections": {}, "matches": {}}
    return layers

"""label: a drive's labels, made by a person on a page in the browser."""

from __future__ import annotations

from pathlib import Path

import click

from lidar_perception.cli.data import a_path, data_option, opened
from lidar_perception.runs.terminal import console, errors


@click.command()
@data_option
@click.option("--sequence", metavar="NAME", help="The drive of PATH to label, where it has "
              "several.")
@a_path("--out", "Folder of the journal; it is gone on with. Default: out/label/NAME OF THE "
        "DRIVE.", "FOLDER")
@click.option("--port", type=click.IntRange(0, 65535), default=0, show_default=True,
              help="Port on 127.0.0.1; 0: any that is free.")
@click.option("--open/--no-open", "browser", default=True, help="Open the page in a browser.  "
              "[default: open]")
def label(data: Path, sequence: str | None, out: Path | None, port: int, browser: bool) -> None:
    """Label a drive on a page in the browser: click, accept, correct.

    Everything is kept at once in FOLDER/journal.jsonl; ctrl-C ends.

    \b
    Examples:
      lidar-perception label --data /data/kitti/tracking
      lidar-perception label --data drive --out labels --no-open --port 8080
    """
    import asyncio
    import webbrowser

    from lidar_perception.labeling.drive import one_drive
    from lidar_perception.labeling.server import Served, serve
    from lidar_perception.labeling.session import session

    drive = one_drive(opened(data), sequence)
    with session(drive, out or Path("out/label") / drive.name) as made:
        if made.journal.message:
            errors.print(made.journal.message, style="yellow", soft_wrap=True)

        def started(url: str) -> None:
            console.print(url, soft_wrap=True, markup=False)
            console.print(f"journal: {made.journal.path}; ctrl-C ends", soft_wrap=True,
                          markup=False, style="dim")
            if browser:
                webbrowser.open(url)
        asyncio.run(serve(Served(drive, made), port, started))

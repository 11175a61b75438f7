"""The label verb: serves the page on which a person labels a drive."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lidar_perception.cli.command import Command
from lidar_perception.cli.data import browser_option, data_argument, open_and_describe, out_folder_option, port_option
from lidar_perception.cli.options import detector_options
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.runs.terminal import console, errors, show_scanning
from lidar_perception.types import InputError

if TYPE_CHECKING:
    from lidar_studio.drive import Drive
    from lidar_studio.session import Session


@click.command(cls=Command)
@data_argument()
@click.option("--sequence", metavar="NAME", help="The drive of DATA to label, if it has several.")
@out_folder_option("Folder of the journal; an existing one is continued. Default: out/label/NAME OF THE DRIVE.")
@port_option
@browser_option
@detector_options()
@click.option(
    "--propose/--no-propose",
    default=True,
    help="Propose tracks for the whole drive at the start, unless the journal has proposals.  [default: propose]",
)
@click.option("--show-labels", is_flag=True, help="Show the existing labels of the drive.")
@click.option(
    "--import",
    "imports",
    multiple=True,
    metavar="FORMAT:PATH",
    help="Import the labels at PATH before the page is served.",
)
@click.option(
    "--export", "exports", metavar="FORMAT:PATH", help="Write the accepted tracks of the journal to PATH and exit."
)
@click.option("--force", is_flag=True, help="With --export: replace existing files.")
def label(
    data: Path,
    sequence: str | None,
    out: Path | None,
    detector: DetectorChoice,
    imports: tuple[str, ...],
    exports: str | None,
    force: bool,
    **page: Any,
) -> None:
    """Label a drive on a page in the browser: click, accept, correct.

    Every action is saved to FOLDER/journal.jsonl immediately; Ctrl-C stops the server.

    \b
    Examples:
      lidar-perception label /data/kitti/tracking --sequence 0000
      lidar-perception label drive --out labels --no-open --port 8080
      lidar-perception label drive --export kitti-tracking:labels
    """
    from lidar_studio.drive import require_clouds, select_drive
    from lidar_studio.journal import JOURNAL_NAME
    from lidar_studio.session import AlreadyImportedError, open_session

    sources = [_split_format_and_path("--import", text) for text in imports]
    target = None if exports is None else _split_format_and_path("--export", exports)
    recording = open_and_describe(data)
    with show_scanning(data):
        drive = select_drive(recording, sequence)
    if target is None:
        require_clouds(drive)
    folder = out or Path("out/label") / drive.name
    if target is not None and not imports and not (folder / JOURNAL_NAME).is_file():
        raise InputError(f"there is no journal in {folder}; give its folder with --out")
    with open_session(drive, folder, detector) as session:
        if session.journal.message:
            errors.print(session.journal.message, style="yellow")
        for format_name, path in sources:
            try:
                session.do({"do": "import", "format": format_name, "path": path})
            except AlreadyImportedError as error:  # the same import command has been run before
                errors.print(str(error), style="yellow")
        if target is not None:
            written = session.export(target[0], os.path.abspath(target[1]), force)
            console.print(f"{written['path']}: {written['boxes']} boxes in {written['frames']} frames")
            for text in written["left_out"]:
                errors.print(f"left out: {text}", style="yellow")
        else:
            _serve(drive, session, **page)


def _split_format_and_path(option: str, text: str) -> tuple[str, str]:
    """Split FORMAT:PATH. InputError for an unknown format, UsageError without a path."""
    from lidar_perception.labels.exchange import FORMATS, READERS
    from lidar_perception.labels.names import resolve_format

    format_name, _, path = text.partition(":")
    if not path:
        raise click.UsageError(f"{option} {text} must be FORMAT:PATH, such as openlabel:labels.json")
    return resolve_format(format_name, READERS if option == "--import" else FORMATS), path


def _serve(drive: Drive, session: Session, port: int, browser: bool, propose: bool, show_labels: bool) -> None:
    import asyncio
    import webbrowser

    from lidar_studio.results import Results
    from lidar_studio.server import PageContent, serve

    count = session.state.seq

    def on_start(url: str) -> None:
        console.print(url)
        state = f"continues after {count} actions" if count else "is new"
        errors.print(f"the journal {session.journal.path.absolute()} {state}; Ctrl-C stops the server", style="dim")
        if propose:
            session.start_proposals()
        if browser:
            webbrowser.open(url)

    layers = Results().bind_layers(drive) if show_labels else None
    asyncio.run(serve(PageContent(drive, session, layers), port, on_start))

"""The label command: serve the page on which a person labels a drive."""

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
@click.option("--sequence", metavar="NAME", help="Drive to label if DATA contains several.")
@out_folder_option("Folder of the journal. An existing journal is resumed. Default: out/label/NAME OF THE DRIVE.")
@port_option
@browser_option
@detector_options()
@click.option(
    "--propose/--no-propose",
    default=True,
    help="Propose tracks for the whole drive at the start, unless the journal already contains proposals."
    "  [default: propose]",
)
@click.option("--show-labels", is_flag=True, help="Also show the labels that DATA contains.")
@click.option(
    "--import",
    "imports",
    multiple=True,
    metavar="FORMAT:PATH",
    help="Import the labels at PATH at the start. May be given several times.",
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
    """Label a drive on a page in the browser: click objects, accept proposals, correct boxes.

    Every action is saved to FOLDER/journal.jsonl immediately. Press Ctrl-C to stop the server.

    \b
    Examples:
      lidar-perception label /data/kitti/tracking --sequence 0000
      lidar-perception label drive --out labels --no-open --port 8080
      lidar-perception label drive --export kitti-tracking:labels
    """
    from lidar_studio.drive import require_clouds, select_drive
    from lidar_studio.journal import JOURNAL_NAME
    from lidar_studio.session import AlreadyImportedError, open_session

    import_sources = [_split_format_and_path("--import", text) for text in imports]
    export_target = None if exports is None else _split_format_and_path("--export", exports)
    recording = open_and_describe(data)
    with show_scanning(data):
        drive = select_drive(recording, sequence)
    if export_target is None:
        require_clouds(drive)
    folder = out or Path("out/label") / drive.name
    if export_target is not None and not imports and not (folder / JOURNAL_NAME).is_file():
        raise InputError(f"no journal in {folder}; specify the folder of the journal with --out")
    with open_session(drive, folder, detector) as session:
        if session.journal.message:
            errors.print(session.journal.message, style="yellow")
        for format_name, path in import_sources:
            try:
                session.execute({"do": "import", "format": format_name, "path": path})
            except AlreadyImportedError as error:  # the same command has been run before
                errors.print(str(error), style="yellow")
        if export_target is not None:
            result = session.export(export_target[0], os.path.abspath(export_target[1]), force)
            console.print(f"{result['path']}: {result['boxes']} boxes in {result['frames']} frames")
            for text in result["left_out"]:
                errors.print(f"left out: {text}", style="yellow")
        else:
            _serve(drive, session, **page)


def _split_format_and_path(option: str, text: str) -> tuple[str, str]:
    """Split FORMAT:PATH. Raises InputError if the format is unknown, UsageError if there is no path."""
    from lidar_perception.labels.exchange import FORMATS, READERS
    from lidar_perception.labels.names import resolve_format

    format_name, _, path = text.partition(":")
    if not path:
        raise click.UsageError(
            f"invalid value {text!r} for {option}; expected FORMAT:PATH, such as openlabel:labels.json"
        )
    return resolve_format(format_name, READERS if option == "--import" else FORMATS), path


def _serve(drive: Drive, session: Session, port: int, browser: bool, propose: bool, show_labels: bool) -> None:
    import asyncio
    import webbrowser

    from lidar_studio.results import Results
    from lidar_studio.server import PageContent, serve

    count = session.state.seq

    def on_start(url: str) -> None:
        console.print(url)
        path = session.journal.path.absolute()
        text = f"resumed {path} after {count} actions" if count else f"started a new journal {path}"
        errors.print(f"{text}; press Ctrl-C to stop the server", style="dim")
        if propose:
            session.start_proposals()
        if browser:
            webbrowser.open(url)

    make_layers = Results().bind_layers(drive) if show_labels else None
    asyncio.run(serve(PageContent(drive, session, make_layers), port, on_start))

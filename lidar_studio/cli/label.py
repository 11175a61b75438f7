"""label: a drive's labels, made by a person on a page in the browser."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lidar_perception.cli.command import Command
from lidar_perception.cli.data import (
    browser_option,
    data_argument,
    json_option,
    opened,
    out_folder,
    port_option,
    write_json,
)
from lidar_perception.cli.options import detector_options
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.runs.terminal import console, errors, make_progress, show_scanning
from lidar_perception.types import InputError

if TYPE_CHECKING:
    from lidar_perception.data.frame import Recording
    from lidar_studio.drive import Drive
    from lidar_studio.session import Session


@click.command(cls=Command)
@data_argument()
@click.option("--sequence", metavar="NAME", help="The drive of DATA to label, where it has "
              "several.")
@out_folder("Folder of the journal; one that is there is continued. Default: out/label/NAME OF THE "
            "DRIVE.")
@port_option
@browser_option
@detector_options()
@click.option("--propose/--no-propose", default=True, help="Look for proposals in the whole drive "
              "at once, unless the journal has some.  [default: propose]")
@click.option("--show-labels", is_flag=True, help="Show the labels that the drive has.")
@click.option("--import", "imports", multiple=True, metavar="FORMAT:PATH",
              help="Take the labels at PATH, before the page is served.")
@click.option("--export", "exports", metavar="FORMAT:PATH", help="Write the accepted tracks of the "
              "journal to PATH, and end.")
@click.option("--force", is_flag=True, help="With --export: replace what is there.")
@click.option("--simulate-annotator", is_flag=True, help="Let a script that knows the labels do "
              "the work, in each drive of DATA, and count its clicks, keys and drags.")
@json_option
def label(data: Path, sequence: str | None, out: Path | None, detector: DetectorChoice,
          imports: tuple[str, ...], exports: str | None, force: bool,
          simulate_annotator: bool, json_file: Path | None, **page: Any) -> None:
    """Label a drive on a page in the browser: click, accept, correct.

    Every action is saved at once to FOLDER/journal.jsonl; ctrl-C ends.

    \b
    Examples:
      lidar-perception label /data/kitti/tracking --sequence 0000
      lidar-perception label drive --out labels --no-open --port 8080
      lidar-perception label drive --export kitti-tracking:labels
    """
    from lidar_studio.drive import one_drive, require_clouds
    from lidar_studio.journal import NAME as JOURNAL
    from lidar_studio.session import ImportedAlready, session

    pairs = [_format_and_path("--import", each) for each in imports]
    target = None if exports is None else _format_and_path("--export", exports)
    recording = opened(data)
    if simulate_annotator:
        write_json(json_file, _simulated(recording, sequence, detector))
        return
    with show_scanning(data):
        drive = one_drive(recording, sequence)
    if target is None:
        require_clouds(drive)
    folder = out or Path("out/label") / drive.name
    if target is not None and not imports and not (folder / JOURNAL).is_file():
        raise InputError(f"there is no journal in {folder}; give its folder with --out")
    with session(drive, folder, detector) as made:
        if made.journal.message:
            errors.print(made.journal.message, style="yellow")
        for named, path in pairs:
            try:
                made.do({"do": "import", "format": named, "path": path})
            except ImportedAlready as error:  # the same command, another day
                errors.print(str(error), style="yellow")
        if target is not None:
            written = made.export(target[0], os.path.abspath(target[1]), force)
            console.print(f"{written['path']}: {written['boxes']} boxes in {written['frames']} "
                          "frames")
            for each in written["left_out"]:
                errors.print(f"left out: {each}", style="yellow")
        else:
            _serve(drive, made, **page)


def _format_and_path(option: str, text: str) -> tuple[str, str]:
    """Split FORMAT:PATH. InputError for an unknown format, UsageError without a path."""
    from lidar_perception.labels.exchange import FORMATS, READERS
    from lidar_perception.labels.names import resolve_format
    named, _, path = text.partition(":")
    if not path:
        raise click.UsageError(f"{option} {text} must be FORMAT:PATH, such as "
                               "openlabel:labels.json")
    return resolve_format(named, READERS if option == "--import" else FORMATS), path


def _serve(drive: Drive, made: Session, port: int, browser: bool, propose: bool,
           show_labels: bool) -> None:
    import asyncio
    import webbrowser

    from lidar_studio.results import Results
    from lidar_studio.served import Served
    from lidar_studio.server import serve

    known = made.state.seq  # a journal begun in another folder is not seen here

    def started(url: str) -> None:
        console.print(url)
        how = f"goes on after {known} actions" if known else "is new"
        errors.print(f"the journal {made.journal.path.absolute()} {how}; ctrl-C ends", style="dim")
        if propose:
            made.prepare()
        if browser:
            webbrowser.open(url)
    layers = Results().layers_of(drive) if show_labels else None
    asyncio.run(serve(Served(drive, made, layers), port, started))


def _simulated(recording: Recording, sequence: str | None,
               detector: DetectorChoice) -> dict[str, Any]:
    from lidar_perception.data.frame import BOXES
    from lidar_studio.annotator import Annotator, totals
    from lidar_studio.drive import one_drive
    from lidar_studio.session import session

    recording.require(BOXES, "label --simulate-annotator")
    found: dict[str, Any] = {}
    with show_scanning(recording.path):
        names = dict.fromkeys(frame.sequence for frame in recording)
    for name in names if sequence is None else [sequence]:
        drive = one_drive(recording, name)
        with (tempfile.TemporaryDirectory() as folder,
              session(drive, Path(folder), detector) as made):
            _propose(drive, made)
            found[drive.name] = done = Annotator(made).work()
        console.print(f"{drive.name}: {done['people']} pedestrians, {done['boxes']} boxes: "
                      f"{done['actions']} actions, {done['looked_at']} proposals looked at; by "
                      f"hand {done['by_hand']}, without tracks {done['without_tracks']}")
    if not any(done["boxes"] for done in found.values()):
        raise InputError(f"{recording.path} has no labelled pedestrian; give another drive")
    sums = totals(found)
    console.print(f"all: {sums['actions']} actions, {sums['share_of_by_hand']:.0%} of those by "
                  f"hand; {sums['share_corrected_in_full']:.0%} where a box is put right in size "
                  f"and heading too; without tracks {sums['share_without_tracks']:.0%}")
    return {"data": str(recording.path), "drives": found, "all": sums}


def _propose(drive: Drive, made: Session) -> None:
    with make_progress() as bar:
        task = bar.add_task(f"{drive.name}: looking for proposals", total=len(drive.frames))
        made.propose(told=lambda count: bar.update(task, completed=count))

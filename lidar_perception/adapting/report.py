"""What adapting leaves for people: report.html, and labels that `label` reads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lidar_perception.adapting.adapt import Adapting, Seen
from lidar_perception.adapting.figures import COLORS, drawn
from lidar_perception.adapting.judging import KEPT, STATES
from lidar_perception.adapting.params import LABELS, REPORT, TITLE
from lidar_perception.data.frame import Frame
from lidar_perception.labeling.exchange import export_labels
from lidar_perception.labeling.labels import DriveLabels, FrameLabels, Row, of_rows
from lidar_perception.runs.files import write_text
from lidar_perception.runs.page import data_url, render
from lidar_perception.types import CLASSES

FORMAT = "openlabel"
PICTURES = 6   # of all pieces


def write_report(run: Adapting) -> None:
    """Write REPORT into the run's folder, also of one that found too little, and of one that
    learned something LABELS."""
    rows = [{"piece": seen.piece.name, "number": number, "name": CLASSES[one.class_id],
             "state": verdict.state, "reason": verdict.reason, "score": one.score,
             "seen": f"{len(one)} of {one.frames[-1] - one.frames[0] + 1} frames"}
            for seen in run.seen for number, (one, verdict) in enumerate(
                zip(seen.tracks, seen.verdicts))]
    rows.sort(key=lambda row: (STATES.index(str(row["state"])), -float(str(row["score"]))))
    write_text(run.out / REPORT, render(
        "adapting/report.html", title=TITLE, run=run, rows=rows, colors=COLORS,
        pictures=pictures(run.seen, run.frames, run.low, run.high)))
    if run.rounds:
        write_labels(run.seen, run.frames, run.out / LABELS)


def pictures(seen: Sequence[Seen], frames: Sequence[Frame], low: np.ndarray,
             high: np.ndarray) -> dict[str, str]:
    """Title -> PNG as a data URL, of PICTURES frames spread over all."""
    places = [(piece, k) for piece in seen for k in range(len(piece.labels))]
    chosen = np.unique(np.linspace(0, len(places) - 1, PICTURES + 2)[1:-1].astype(int))
    found = {}
    for piece, k in (places[i] for i in chosen):
        frame = frames[piece.piece.numbers[k]]
        png = drawn(frame.load().xyz, piece.labels[k], low, high)
        title = f"{piece.piece.name}, frame {piece.piece.numbers[k]}: {frame.name}"
        found[title] = data_url(png)
    return found


def write_labels(seen: Sequence[Seen], frames: Sequence[Frame], out: Path) -> None:
    """What is kept, of all frames that were looked at, in FORMAT: one track for each object."""
    found: dict[int, FrameLabels] = {}
    first = 1
    for piece in seen:
        for k, number in enumerate(piece.piece.numbers):
            own = piece.labels[k]
            found[number] = of_rows(frames[number], [
                _row(piece, own.boxes[i], int(own.numbers[i]), first)
                for i in np.flatnonzero(own.of(KEPT))])
        first += len(piece.tracks)
    chosen = sorted(found)
    export_labels(DriveLabels([found[n] for n in chosen]), FORMAT, out, [frames[n] for n in chosen],
                  force=True)


def _row(piece: Seen, box: np.ndarray, number: int, first: int) -> Row:
    one, verdict = piece.tracks[number], piece.verdicts[number]
    return (box.tolist(), CLASSES[one.class_id], first + number, round(one.score, 3),
            {"why": verdict.reason})

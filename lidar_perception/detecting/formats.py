"""The formats of results: one class each, which gets the frames in order of time."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import repeat
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.frame import Recording
from lidar_perception.data.kitti.results import (
    FOLDER,
    choose_calibration,
    write_results,
    write_tracking_results,
)
from lidar_perception.detecting.results import FrameResult, short_floats, with_optional_parts
from lidar_perception.labels.drive_labels import DriveLabels, FrameLabels
from lidar_perception.labels.exchange import export_labels
from lidar_perception.runs.files import write_text
from lidar_perception.types import CLASSES, Detections

BOX = ("x", "y", "z", "length", "width", "height", "yaw")
COLUMNS = ("frame", "sequence", "index", "stamp_ns", "frame_id", "id", "class", "score", *BOX,
           "velocity_x", "velocity_y")

UNITS = {
    "box": "x y z of the centre, length, width, height in metres, yaw in radians counter-clockwise "
           "from x, in the LiDAR frame of the cloud: x forward, y left, z up",
    "velocity": "metres a second over ground along x and y of the LiDAR frame; relative to the "
                "sensor where ego is none", "score": "0..1", "stamp_ns": "nanoseconds",
    "ms": "milliseconds of the detector"}


@dataclass
class Run:
    """A run of a detector, as its formats see it.

    recording: its data; out: its folder; header: a JSON object, see run.header_of; count: the
    number of frames to write; skipped: a line for each of them that could not be read or written;
    remarks: lines about the results, grouped by their text without numbers.
    """

    recording: Recording
    out: Path
    header: dict[str, Any]
    count: int
    skipped: list[str] = field(default_factory=list)
    remarks: dict[str, dict[str, None]] = field(default_factory=dict)

    def say(self, remark: str) -> None:
        """Add a remark, once."""
        self.remarks.setdefault(mask_numbers(remark), {})[remark] = None


class Format(Protocol):
    """A context manager that gets all results in order of time; path, where they are, is complete
    after it. needs_scans: it draws or writes the points, too. InputError where results cannot be
    written."""

    path: Path
    needs_scans: bool

    def __enter__(self) -> Self: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None: ...

    def add(self, result: FrameResult) -> None:
        """Write the result of the next frame."""


class WrittenAtEnd:
    """Base of formats that write everything at the end, if no error came before."""

    needs_scans = False

    def __init__(self, run: Run, path: Path) -> None:
        self.run, self.path = run, path

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: Any) -> None:
        if kind is None:
            self.finish()

    def finish(self) -> None:
        """Write the file or files."""


class Kitti(WrittenAtEnd):
    """Result files of KITTI's object benchmark, kitti/FRAME.txt; with tracks those of its tracking
    benchmark, kitti/SEQUENCE.txt, where drives without a name are 0000, 0001, and so on, and their
    frames are counted from 0."""

    def __init__(self, run: Run) -> None:
        super().__init__(run, run.out / FOLDER)
        self.drives: dict[str, list[tuple[int, np.ndarray, Detections]]] = {}
        self.names: dict[str, str] = {}
        self.cameras: dict[str, Calibration] = {}

    def add(self, result: FrameResult) -> None:
        """Write the file of a frame, or keep its tracks for that of their drive."""
        frame = result.frame
        calibration, nominal = choose_calibration(frame)
        if nominal:
            self.run.say("there is no camera calibration: kitti/ is in the frame of a nominal "
                         "camera, level and 0.27 m ahead of the LiDAR")
        if result.tracks is None:
            write_results(self.path / f"{frame.name}.txt", result.objects, calibration)
            return
        drive = self.drives.setdefault(result.drive, [])
        self.names.setdefault(result.drive, frame.sequence or f"{len(self.names):04}")
        self.cameras.setdefault(result.drive, calibration)
        drive.append((frame.index, result.tracks.ids, result.objects))

    def finish(self) -> None:
        for drive, frames in self.drives.items():
            name = self.names[drive]
            first = 0 if name == drive else frames[0][0]  # a drive without a name begins at 0
            write_tracking_results(self.path / f"{name}.txt",
                                   [(number - first, ids, found) for number, ids, found in frames],
                                   self.cameras[drive])


class Json(WrittenAtEnd):
    """One JSON document, detections.json: a header, then one frame on each line."""

    def __init__(self, run: Run) -> None:
        super().__init__(run, run.out / "detections.json")
        self.lines: list[str] = []

    def add(self, result: FrameResult) -> None:
        """Keep the line of a frame."""
        frame = result.frame
        self.lines.append(json.dumps({
            "name": frame.name, "sequence": frame.sequence, "index": frame.index,
            "stamp_ns": frame.stamp_ns, "frame_id": result.frame_id, "ms": result.ms,
            "problem": result.problem, "objects": rows(result)}, allow_nan=False))

    def finish(self) -> None:
        head = json.dumps({"format": "lidar_perception detections", "units": UNITS,
                           **self.run.header, "skipped": self.run.skipped}, indent=1)
        write_text(self.path, f'{head[:-2]},\n "frames": [\n' + ",\n".join(self.lines) + "\n]}")


class Csv(WrittenAtEnd):
    """One table, detections.csv, of a row for each object; see COLUMNS."""

    def __init__(self, run: Run) -> None:
        super().__init__(run, run.out / "detections.csv")
        self.text = io.StringIO()
        self.table = csv.writer(self.text, lineterminator="\n")
        self.table.writerow(COLUMNS)

    def add(self, result: FrameResult) -> None:
        """Keep the rows of a frame."""
        frame = result.frame
        for row in rows(result):
            self.table.writerow([
                frame.name, frame.sequence, frame.index, frame.stamp_ns, result.frame_id,
                row["id"], row["class"], row["score"], *(row[name] for name in BOX),
                *(row["velocity"] or (None, None))])

    def finish(self) -> None:
        write_text(self.path, self.text.getvalue())


class OpenLabel(WrittenAtEnd):
    """ASAM OpenLABEL, openlabel/SEQUENCE.json, as `convert` and `label` read it; 0000.json where
    there are no sequences. The velocity of a track is an attribute of its cuboid."""

    def __init__(self, run: Run) -> None:
        super().__init__(run, run.out / "openlabel")
        self.labels: dict[str, FrameLabels] = {}

    def add(self, result: FrameResult) -> None:
        """Keep the labels of a frame."""
        frame, found = result.frame, rows(result)
        self.labels[frame.name] = FrameLabels.of(
            frame.name, frame.stamp_ns, result.objects.boxes, [row["class"] for row in found],
            [-1 if row["id"] is None else row["id"] for row in found],
            [row["score"] for row in found],
            [{"velocity": row["velocity"]} if row["velocity"] else {} for row in found])

    def finish(self) -> None:
        frames = [with_optional_parts(self.run.recording.frames[i], self.run.say)
                  for i in range(self.run.count)]
        labels = [self.labels.get(frame.name) or FrameLabels.of(frame.name, frame.stamp_ns)
                  for frame in frames]
        export_labels(DriveLabels(labels), "openlabel", self.path, frames, force=True)


FORMATS: Mapping[str, type] = {"kitti": Kitti, "json": Json, "csv": Csv, "openlabel": OpenLabel}


def mask_numbers(line: str) -> str:
    """Return a line with # for its numbers, so that it is the same for many frames."""
    return re.sub(r"\d[\d.]*", "#", line)


def rows(result: FrameResult) -> list[dict[str, Any]]:
    """The objects of a frame as JSON objects: id and velocity, None without tracks, class, score,
    and the box by the names of BOX."""
    found, tracks = result.objects, result.tracks
    ids = repeat(None) if tracks is None else tracks.ids.tolist()
    velocities = repeat(None) if tracks is None else short_floats(tracks.velocities)
    return [{"id": number, "class": CLASSES[c], "score": score, **dict(zip(BOX, box)),
             "velocity": velocity}
            for number, velocity, c, score, box in zip(
                ids, velocities, found.class_ids, short_floats(found.scores),
                short_floats(found.boxes))]

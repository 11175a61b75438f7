"""Output formats of detect. Each class writes one format and receives the results in chronological order."""

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
from lidar_perception.data.kitti.results import RESULT_FOLDER, choose_calibration, write_results, write_tracking_results
from lidar_perception.detecting.results import FrameResult, to_short_floats, with_optional_parts
from lidar_perception.labels.drive_labels import DriveLabels, FrameLabels
from lidar_perception.labels.exchange import export_labels
from lidar_perception.runs.files import write_text
from lidar_perception.types import CLASSES, Detections

BOX = ("x", "y", "z", "length", "width", "height", "yaw")
COLUMNS = (
    "frame",
    "sequence",
    "index",
    "stamp_ns",
    "frame_id",
    "id",
    "class",
    "score",
    *BOX,
    "velocity_x",
    "velocity_y",
)

UNITS = {
    "box": "x y z of the centre, length, width, height in metres, yaw in radians counter-clockwise "
    "from x, in the LiDAR frame of the cloud: x forward, y left, z up",
    "velocity": "metres per second over ground along x and y of the LiDAR frame; relative to the sensor if ego is none",
    "score": "0..1",
    "stamp_ns": "nanoseconds",
    "ms": "milliseconds of the detector",
}


@dataclass
class Run:
    """A run of a detector on a recording.

    Attributes:
        recording: input data.
        out: output folder.
        header: JSON object, see run.make_header.
        count: number of frames to process.
        skipped: one line for each frame that could not be read or written.
        remarks: notes for the user; keys are their texts with numbers masked.
    """

    recording: Recording
    out: Path
    header: dict[str, Any]
    count: int
    skipped: list[str] = field(default_factory=list)
    remarks: dict[str, dict[str, None]] = field(default_factory=dict)

    def add_remark(self, remark: str) -> None:
        """Add a remark if it is new."""
        self.remarks.setdefault(mask_numbers(remark), {})[remark] = None


class Format(Protocol):
    """Context manager that writes results in one format.

    It receives the results in chronological order, and raises InputError if they cannot be written.

    Attributes:
        path: output file or folder, complete when the context is left.
        needs_scans: True if the format uses the points of the clouds.
    """

    path: Path
    needs_scans: bool

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def add(self, result: FrameResult) -> None:
        """Write the result of the next frame."""


class BufferedFormat:
    """Base class of formats that write all results at the end, unless there was an error."""

    needs_scans = False

    def __init__(self, run: Run, path: Path) -> None:
        self.run, self.path = run, path

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: Any) -> None:
        if kind is None:
            self.finish()

    def finish(self) -> None:
        """Write the output files."""


class Kitti(BufferedFormat):
    """Result files in the formats of the KITTI benchmarks.

    Detections are written in the format of the object benchmark, kitti/FRAME.txt, and tracks in the
    format of the tracking benchmark, kitti/SEQUENCE.txt. Drives without a name are numbered 0000,
    0001, ..., and their frames are numbered from 0.
    """

    def __init__(self, run: Run) -> None:
        super().__init__(run, run.out / RESULT_FOLDER)
        self.drives: dict[str, list[tuple[int, np.ndarray, Detections]]] = {}
        self.names: dict[str, str] = {}
        self.cameras: dict[str, Calibration] = {}

    def add(self, result: FrameResult) -> None:
        """Write the detections of a frame, or keep its tracks for the file of the drive."""
        frame = result.frame
        calibration, is_nominal = choose_calibration(frame)
        if is_nominal:
            self.run.add_remark(
                "no camera calibration: boxes in kitti/ are relative to a nominal camera, level and 0.27 m ahead of "
                "the LiDAR"
            )
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
            first_number = 0 if name == drive else frames[0][0]  # frames of unnamed drives are numbered from 0
            write_tracking_results(
                self.path / f"{name}.txt",
                [(number - first_number, ids, detections) for number, ids, detections in frames],
                self.cameras[drive],
            )


class Json(BufferedFormat):
    """One JSON file, detections.json: a header, followed by one frame per line."""

    def __init__(self, run: Run) -> None:
        super().__init__(run, run.out / "detections.json")
        self.lines: list[str] = []

    def add(self, result: FrameResult) -> None:
        """Format the line of a frame."""
        frame = result.frame
        self.lines.append(
            json.dumps(
                {
                    "name": frame.name,
                    "sequence": frame.sequence,
                    "index": frame.index,
                    "stamp_ns": frame.stamp_ns,
                    "frame_id": result.frame_id,
                    "ms": result.ms,
                    "problem": result.problem,
                    "objects": make_rows(result),
                },
                allow_nan=False,
            )
        )

    def finish(self) -> None:
        header = json.dumps(
            {"format": "lidar_perception detections", "units": UNITS, **self.run.header, "skipped": self.run.skipped},
            indent=1,
        )
        write_text(self.path, f'{header[:-2]},\n "frames": [\n' + ",\n".join(self.lines) + "\n]}")


class Csv(BufferedFormat):
    """One table, detections.csv, with one row per object; see COLUMNS."""

    def __init__(self, run: Run) -> None:
        super().__init__(run, run.out / "detections.csv")
        self.text = io.StringIO()
        self.table = csv.writer(self.text, lineterminator="\n")
        self.table.writerow(COLUMNS)

    def add(self, result: FrameResult) -> None:
        """Format the rows of a frame."""
        frame = result.frame
        for row in make_rows(result):
            self.table.writerow(
                [
                    frame.name,
                    frame.sequence,
                    frame.index,
                    frame.stamp_ns,
                    result.frame_id,
                    row["id"],
                    row["class"],
                    row["score"],
                    *(row[name] for name in BOX),
                    *(row["velocity"] or (None, None)),
                ]
            )

    def finish(self) -> None:
        write_text(self.path, self.text.getvalue())


class OpenLabel(BufferedFormat):
    """ASAM OpenLABEL files, openlabel/SEQUENCE.json, for the commands `convert` and `label`.

    Recordings without sequences have one file, 0000.json. The velocity of a track is an attribute
    of its cuboid.
    """

    def __init__(self, run: Run) -> None:
        super().__init__(run, run.out / "openlabel")
        self.labels: dict[str, FrameLabels] = {}

    def add(self, result: FrameResult) -> None:
        """Keep the labels of a frame."""
        frame, rows = result.frame, make_rows(result)
        self.labels[frame.name] = FrameLabels.of(
            frame.name,
            frame.stamp_ns,
            result.objects.boxes,
            [row["class"] for row in rows],
            [-1 if row["id"] is None else row["id"] for row in rows],
            [row["score"] for row in rows],
            [{"velocity": row["velocity"]} if row["velocity"] else {} for row in rows],
        )

    def finish(self) -> None:
        frames = [with_optional_parts(self.run.recording.frames[i], self.run.add_remark) for i in range(self.run.count)]
        labels = [self.labels.get(frame.name) or FrameLabels.of(frame.name, frame.stamp_ns) for frame in frames]
        export_labels(DriveLabels(labels), "openlabel", self.path, frames, force=True)


FORMATS: Mapping[str, type] = {"kitti": Kitti, "json": Json, "csv": Csv, "openlabel": OpenLabel}


def mask_numbers(line: str) -> str:
    """Replace the numbers in a line by #, so that lines of different frames can be grouped."""
    return re.sub(r"\d[\d.]*", "#", line)


def make_rows(result: FrameResult) -> list[dict[str, Any]]:
    """Return the objects of a frame as JSON objects.

    Their keys are id and velocity (both None without tracks), class, score, and the box values in
    BOX.
    """
    objects, tracks = result.objects, result.tracks
    ids = repeat(None) if tracks is None else tracks.ids.tolist()
    velocities = repeat(None) if tracks is None else to_short_floats(tracks.velocities)
    return [
        {"id": track_id, "class": CLASSES[class_id], "score": score, **dict(zip(BOX, box)), "velocity": velocity}
        for track_id, velocity, class_id, score, box in zip(
            ids, velocities, objects.class_ids, to_short_floats(objects.scores), to_short_floats(objects.boxes)
        )
    ]

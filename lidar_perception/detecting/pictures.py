"""Results as pictures and as a film."""

from __future__ import annotations

from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import numpy as np

from lidar_perception.detecting.formats import Run
from lidar_perception.detecting.results import FrameResult
from lidar_perception.rendering.files import Film, open_film, read_png_note, write_png
from lidar_perception.rendering.picture import Boxes, Stage, draw_frame

PERIOD_S = 0.1  # of a picture without a next one
SHORTEST_S, LONGEST_S = 0.02, 0.5  # that a picture of a film is shown
SHOWN_MOVING = 0.5  # from this probability of motion on there is a speed
FIRST_DATE_NS = 10**18  # a stamp after September 2001 is a date; those before count from a start


class FrameDrawer:
    """Draw results; all pictures of a run show the same part of the world. color: of the points,
    "height" or "intensity"; size: width and height, pixels."""

    def __init__(self, run: Run, color: str = "height",
                 size: tuple[int, int] = (1280, 720)) -> None:
        self.run, self.color, self.size = run, color, size
        self.stage: Stage | None = None
        self._first_ns = 0
        self._drawn: tuple[str, np.ndarray] | None = None

    def stage_of(self, result: FrameResult) -> Stage:
        """Return the stage of the run, which the first result determines."""
        if self.stage is None:
            self._first_ns = result.frame.stamp_ns
            self.stage = Stage.of(result.frame.load(), result.frame.sensor_height,
                                  self.run.header.get("range") == "ahead", self.color, self.size)
        return self.stage

    def __call__(self, result: FrameResult) -> np.ndarray:
        """Return the picture (height, width, 3) uint8 of a result. InputError where its scan cannot
        be read."""
        frame = result.frame
        if self._drawn is None or self._drawn[0] != frame.name:
            truth = frame.truth()
            labels = np.zeros((0, 7)) if truth is None else truth.boxes
            image = draw_frame(self.stage_of(result), frame.load(), boxes_of(result), labels,
                               self.title(result), self.time(frame.stamp_ns))
            self._drawn = frame.name, image
        return self._drawn[1]

    def title(self, result: FrameResult) -> str:
        """Name the recording, the frame and the detector."""
        frame = result.frame
        name = f"#{frame.index}" if frame.name.startswith(str(frame.stamp_ns)) else frame.name
        path = self.run.recording.path
        return "  ".join([*[path.name] * (path.stem != name), name, self.run.header["detector"]])

    def time(self, stamp_ns: int) -> str:
        """Write a stamp as a date, or without one as seconds since the first frame."""
        if self.run.recording.has_times and stamp_ns >= FIRST_DATE_NS:
            date = datetime.fromtimestamp(stamp_ns // 10**9, UTC)
            return f"{date:%Y-%m-%d %H:%M:%S}.{stamp_ns // 10**6 % 1000:03} UTC"
        return f"{(stamp_ns - self._first_ns) / 1e9:.1f} s"


def boxes_of(result: FrameResult) -> Boxes:
    """Return the boxes of a result with their texts: the id and the speed of tracks, else the
    score."""
    found, tracks = result.objects, result.tracks
    if tracks is None:
        return Boxes(found.boxes, found.class_ids, [f"{score:.2f}" for score in found.scores])
    moving = tracks.moving >= SHOWN_MOVING
    velocities = np.where(moving[:, None], tracks.velocities, 0.0)
    texts = [f"{number}  {np.hypot(*velocity):.1f} m/s" if moves else str(number)
             for number, velocity, moves in zip(tracks.ids.tolist(), velocities, moving)]
    return Boxes(found.boxes, found.class_ids, texts, result.trails, velocities)


class Pictures:
    """A picture of every frame, png/FRAME.png. One that an earlier run has drawn is kept."""

    needs_scans = True

    def __init__(self, run: Run, drawer: FrameDrawer) -> None:
        self.drawer, self.path = drawer, run.out / "png"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        pass

    def add(self, result: FrameResult) -> None:
        """Draw a frame and write its picture."""
        path = self.path / f"{result.frame.name}.png"
        stage = repr(self.drawer.stage_of(result))
        if read_png_note(path) != stage:
            write_png(path, self.drawer(result), stage)


class FilmOfFrames:
    """A film of all frames, each shown until the next one in time."""

    needs_scans = True

    def __init__(self, run: Run, drawer: FrameDrawer, path: Path) -> None:
        self.drawer, self.path = drawer, path
        self._writing: AbstractContextManager[Film] = open_film(path, drawer.size)
        self._last: tuple[int, np.ndarray] | None = None  # stamp and picture

    def __enter__(self) -> Self:
        self.film = self._writing.__enter__()
        return self

    def add(self, result: FrameResult) -> None:
        """Draw a frame; the one before is written."""
        picture, stamp_ns = self.drawer(result), result.frame.stamp_ns
        if self._last is not None:
            self.film.add(self._last[1], float(np.clip((stamp_ns - self._last[0]) / 1e9,
                                                       SHORTEST_S, LONGEST_S)))
        self._last = stamp_ns, picture

    def __exit__(self, *error: Any) -> None:
        try:
            if error[0] is None and self._last is not None:
                self.film.add(self._last[1], PERIOD_S)
        finally:
            self._writing.__exit__(*error)

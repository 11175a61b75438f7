"""Results as pictures and as a video."""

from __future__ import annotations

from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import numpy as np

from lidar_perception.detecting.formats import Run
from lidar_perception.detecting.results import FrameResult
from lidar_perception.rendering.files import VideoFile, open_video, read_png_note, write_png
from lidar_perception.rendering.picture import Boxes, Stage, draw_frame

LAST_PICTURE_S = 0.1  # duration of the last picture of a video
MIN_PICTURE_S, MAX_PICTURE_S = 0.02, 0.5  # duration of the other pictures
MIN_MOVING = 0.5  # speeds are shown for tracks with at least this probability of motion
MIN_DATE_NS = 10**18  # stamps from September 2001 on are dates; smaller ones are relative times


class FrameDrawer:
    """Draws results; all pictures of a run show the same area.

    Args:
        color: value that determines the colours of the points, "height" or "intensity".
        size: width and height in pixels.
    """

    def __init__(self, run: Run, color: str = "height", size: tuple[int, int] = (1280, 720)) -> None:
        self.run, self.color, self.size = run, color, size
        self.stage: Stage | None = None
        self._first_ns = 0
        self._drawn: tuple[str, np.ndarray] | None = None

    def get_stage(self, result: FrameResult) -> Stage:
        """Return the stage of the run, which is created from the first result."""
        if self.stage is None:
            self._first_ns = result.frame.stamp_ns
            self.stage = Stage.of(
                result.frame.load(),
                result.frame.sensor_height,
                self.run.header.get("range") == "ahead",
                self.color,
                self.size,
            )
        return self.stage

    def __call__(self, result: FrameResult) -> np.ndarray:
        """Return the picture (height, width, 3) uint8 of a result.

        Raises:
            InputError: the scan cannot be read.
        """
        frame = result.frame
        if self._drawn is None or self._drawn[0] != frame.name:
            truth = frame.truth()
            labels = np.zeros((0, 7)) if truth is None else truth.boxes
            image = draw_frame(
                self.get_stage(result),
                frame.load(),
                make_labelled_boxes(result),
                labels,
                self.title(result),
                self.time(frame.stamp_ns),
            )
            self._drawn = frame.name, image
        return self._drawn[1]

    def title(self, result: FrameResult) -> str:
        """Return the title of a picture, with recording, frame and detector."""
        frame = result.frame
        name = f"#{frame.index}" if frame.name.startswith(str(frame.stamp_ns)) else frame.name
        path = self.run.recording.path
        return "  ".join([*[path.name] * (path.stem != name), name, self.run.header["detector"]])

    def time(self, stamp_ns: int) -> str:
        """Format a stamp as a date, or as seconds since the first frame if it is not a date."""
        if self.run.recording.has_times and stamp_ns >= MIN_DATE_NS:
            date = datetime.fromtimestamp(stamp_ns // 10**9, UTC)
            return f"{date:%Y-%m-%d %H:%M:%S}.{stamp_ns // 10**6 % 1000:03} UTC"
        return f"{(stamp_ns - self._first_ns) / 1e9:.1f} s"


def make_labelled_boxes(result: FrameResult) -> Boxes:
    """Return the boxes of a result with their texts: id and speed of tracks, otherwise the score."""
    objects, tracks = result.objects, result.tracks
    if tracks is None:
        return Boxes(objects.boxes, objects.class_ids, [f"{score:.2f}" for score in objects.scores])
    is_moving = tracks.moving >= MIN_MOVING
    velocities = np.where(is_moving[:, None], tracks.velocities, 0.0)
    texts = [
        f"{track_id}  {np.hypot(*velocity):.1f} m/s" if moves else str(track_id)
        for track_id, velocity, moves in zip(tracks.ids.tolist(), velocities, is_moving)
    ]
    return Boxes(objects.boxes, objects.class_ids, texts, result.trails, velocities)


class PictureWriter:
    """Writes a picture of every frame, png/FRAME.png. Pictures of an earlier run are kept."""

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
        stage = repr(self.drawer.get_stage(result))
        if read_png_note(path) != stage:
            write_png(path, self.drawer(result), stage)


class VideoWriter:
    """Writes a video of all frames with the timing of the recording."""

    needs_scans = True

    def __init__(self, run: Run, drawer: FrameDrawer, path: Path) -> None:
        self.drawer, self.path = drawer, path
        self._writing: AbstractContextManager[VideoFile] = open_video(path, drawer.size)
        self._last: tuple[int, np.ndarray] | None = None  # stamp and picture

    def __enter__(self) -> Self:
        self.video_file = self._writing.__enter__()
        return self

    def add(self, result: FrameResult) -> None:
        """Draw a frame and write the previous one, whose duration is now known."""
        picture, stamp_ns = self.drawer(result), result.frame.stamp_ns
        if self._last is not None:
            self.video_file.add(
                self._last[1], float(np.clip((stamp_ns - self._last[0]) / 1e9, MIN_PICTURE_S, MAX_PICTURE_S))
            )
        self._last = stamp_ns, picture

    def __exit__(self, *error: Any) -> None:
        try:
            if error[0] is None and self._last is not None:
                self.video_file.add(self._last[1], LAST_PICTURE_S)
        finally:
            self._writing.__exit__(*error)

"""Output of results as pictures and as a video."""

from __future__ import annotations

from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import numpy as np

from lidar_perception.detecting.formats import Run
from lidar_perception.detecting.results import FrameResult
from lidar_perception.rendering.files import VideoFile, open_video, read_png_note, write_png
from lidar_perception.rendering.picture import Boxes, RenderSettings, draw_frame

LAST_FRAME_S = 0.1  # duration of a video's last frame
MIN_FRAME_S, MAX_FRAME_S = 0.02, 0.5  # limits for the duration of the other frames
MIN_MOVING = 0.5  # minimum probability of motion to show the speed of a track
MIN_DATE_NS = 10**18  # stamps from September 2001 on are dates, smaller ones are relative times


class FrameDrawer:
    """Renderer of results as pictures, which show the same area in all frames of a run.

    Args:
        color: quantity that determines the colours of the points, "height" or "intensity".
        size: width and height in pixels.
    """

    def __init__(self, run: Run, color: str = "height", size: tuple[int, int] = (1280, 720)) -> None:
        self.run, self.color, self.size = run, color, size
        self.settings: RenderSettings | None = None
        self._first_ns = 0
        self._last_picture: tuple[str, np.ndarray] | None = None  # name of the frame and picture

    def get_settings(self, result: FrameResult) -> RenderSettings:
        """Return the settings of the run; create them from the first result."""
        if self.settings is None:
            self._first_ns = result.frame.stamp_ns
            self.settings = RenderSettings.of(
                result.frame.load(),
                result.frame.sensor_height,
                self.run.header.get("range") == "ahead",
                self.color,
                self.size,
            )
        return self.settings

    def __call__(self, result: FrameResult) -> np.ndarray:
        """Return the picture (height, width, 3) uint8 of a result.

        Raises:
            InputError: the scan cannot be read.
        """
        frame = result.frame
        if self._last_picture is None or self._last_picture[0] != frame.name:
            truth = frame.truth()
            labels = np.zeros((0, 7)) if truth is None else truth.boxes
            picture = draw_frame(
                self.get_settings(result),
                frame.load(),
                make_annotated_boxes(result),
                labels,
                self.make_title(result),
                self.format_time(frame.stamp_ns),
            )
            self._last_picture = frame.name, picture
        return self._last_picture[1]

    def make_title(self, result: FrameResult) -> str:
        """Return the title of a picture: recording, frame and detector."""
        frame = result.frame
        name = f"#{frame.index}" if frame.name.startswith(str(frame.stamp_ns)) else frame.name
        path = self.run.recording.path
        return "  ".join([*[path.name] * (path.stem != name), name, self.run.header["detector"]])

    def format_time(self, stamp_ns: int) -> str:
        """Format a stamp as a date, or as seconds since the first frame if it is not a date."""
        if self.run.recording.has_times and stamp_ns >= MIN_DATE_NS:
            date = datetime.fromtimestamp(stamp_ns // 10**9, UTC)
            return f"{date:%Y-%m-%d %H:%M:%S}.{stamp_ns // 10**6 % 1000:03} UTC"
        return f"{(stamp_ns - self._first_ns) / 1e9:.1f} s"


def make_annotated_boxes(result: FrameResult) -> Boxes:
    """Return the boxes of a result with texts: id and speed of tracks, or the score of detections."""
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
    """Output format that writes a picture of each frame, png/FRAME.png. Existing pictures are kept."""

    needs_scans = True

    def __init__(self, run: Run, drawer: FrameDrawer) -> None:
        self.drawer, self.path = drawer, run.out / "png"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        pass

    def add(self, result: FrameResult) -> None:
        """Draw a frame and write the picture."""
        path = self.path / f"{result.frame.name}.png"
        settings = repr(self.drawer.get_settings(result))
        if read_png_note(path) != settings:
            write_png(path, self.drawer(result), settings)


class VideoWriter:
    """Output format that writes a video of all frames with the timing of the recording."""

    needs_scans = True

    def __init__(self, run: Run, drawer: FrameDrawer, path: Path) -> None:
        self.drawer, self.path = drawer, path
        self._video_context: AbstractContextManager[VideoFile] = open_video(path, drawer.size)
        self._pending: tuple[int, np.ndarray] | None = None  # stamp and picture of the last frame

    def __enter__(self) -> Self:
        self.video_file = self._video_context.__enter__()
        return self

    def add(self, result: FrameResult) -> None:
        """Draw a frame and write the previous one, whose duration is now known."""
        picture, stamp_ns = self.drawer(result), result.frame.stamp_ns
        if self._pending is not None:
            self.video_file.add(
                self._pending[1], float(np.clip((stamp_ns - self._pending[0]) / 1e9, MIN_FRAME_S, MAX_FRAME_S))
            )
        self._pending = stamp_ns, picture

    def __exit__(self, *error: Any) -> None:
        try:
            if error[0] is None and self._pending is not None:
                self.video_file.add(self._pending[1], LAST_FRAME_S)
        finally:
            self._video_context.__exit__(*error)

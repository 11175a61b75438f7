"""Writing of pictures and videos: PNG, GIF and WebP with Pillow, MP4 with PyAV (extra [video])."""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from PIL import Image, PngImagePlugin

from lidar_perception.runs.files import write_bytes
from lidar_perception.types import InputError

VIDEO_SUFFIXES, ANIMATION_SUFFIXES = (".mp4", ".mkv", ".mov"), (".gif", ".webp")
ANIMATED_WIDTH = 960  # width of an animation in pixels
MAX_ANIMATED = 300  # maximum number of frames of an animation, which is held in memory
TICKS = 1000  # ticks per second
PNG_KEY, PNG_LEVEL = "lidar_perception", 3
QUALITY = {"crf": "20", "preset": "veryfast"}


def write_png(path: Path, picture: np.ndarray, note: str = "") -> None:
    """Write a picture (height, width, 3) uint8 with a note for read_png_note().

    Raises:
        InputError: the file cannot be written.
    """
    info, stream = PngImagePlugin.PngInfo(), io.BytesIO()
    info.add_text(PNG_KEY, note)
    Image.fromarray(picture).save(stream, "png", pnginfo=info, compress_level=PNG_LEVEL)
    write_bytes(path, stream.getbuffer())


def read_png_note(path: Path) -> str | None:
    """Return the note in a picture that write_png wrote; None if it has no note."""
    try:
        with Image.open(path) as image:
            return image.info.get(PNG_KEY)
    except OSError:
        return None


class VideoFile(Protocol):
    """Video that is being written."""

    def add(self, picture: np.ndarray, seconds: float) -> None:
        """Add a picture (height, width, 3) uint8 that is shown for `seconds`."""


def check_video(path: Path, count: int) -> None:
    """Raise InputError if a video of `count` pictures cannot be written to a path."""
    if path.suffix not in (*VIDEO_SUFFIXES, *ANIMATION_SUFFIXES):
        raise InputError(
            f"{path} is not a video: its name must end in one of {', '.join((*VIDEO_SUFFIXES, *ANIMATION_SUFFIXES))}"
        )
    if path.suffix in VIDEO_SUFFIXES and importlib.util.find_spec("av") is None:
        raise InputError(
            f"{path} needs PyAV: pip install 'lidar_perception[video]', or use a name that ends in .gif or .webp"
        )
    if path.suffix in ANIMATION_SUFFIXES and count > MAX_ANIMATED:
        raise InputError(
            f"{path} would have {count} pictures, and {path.suffix} files have at "
            f"most {MAX_ANIMATED}; use --limit, or a name that ends in .mp4"
        )


@contextmanager
def open_video(path: Path, size: tuple[int, int]) -> Iterator[VideoFile]:
    """Open a video with pictures of a size (width, height) for writing.

    The file appears when it is complete. No file is written if no picture is added.

    Raises:
        InputError: The video cannot be written.
    """
    partial = path.with_name(f".{path.stem}.incomplete{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        writer: Any = _H264File(partial, size) if path.suffix in VIDEO_SUFFIXES else _AnimationFile(partial)
        yield writer
        if writer.ticks:
            writer.close()
            partial.replace(path)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from None
    finally:
        partial.unlink(missing_ok=True)


class _H264File:
    """H.264 video; pictures are cropped to an even width and height."""

    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        import av

        self.video = av
        self.container = av.open(str(path), "w")
        self.stream = self.container.add_stream("libx264", rate=30, options=QUALITY)
        self.stream.width, self.stream.height = (side - side % 2 for side in size)
        self.stream.pix_fmt = "yuv420p"
        self.stream.codec_context.time_base = Fraction(1, TICKS)
        self.ticks = 0

    def add(self, picture: np.ndarray, seconds: float) -> None:
        frame = self.video.VideoFrame.from_ndarray(
            np.ascontiguousarray(picture[: self.stream.height, : self.stream.width]), format="rgb24"
        )
        frame.pts, frame.time_base = self.ticks, Fraction(1, TICKS)
        self.ticks += max(1, round(seconds * TICKS))
        self.container.mux(self.stream.encode(frame))

    def close(self) -> None:
        self.container.mux(self.stream.encode(None))
        self.container.close()


class _AnimationFile:
    """Animated GIF or WebP, which Pillow writes in one call."""

    def __init__(self, path: Path) -> None:
        self.path, self.ticks = path, 0
        self.pictures: list[Image.Image] = []
        self.durations: list[int] = []  # frame durations in milliseconds

    def add(self, picture: np.ndarray, seconds: float) -> None:
        image = Image.fromarray(picture)
        image.thumbnail((ANIMATED_WIDTH, ANIMATED_WIDTH), Image.Resampling.LANCZOS)
        if self.path.suffix == ".gif":
            image = image.quantize(128, dither=Image.Dither.NONE)
        self.pictures.append(image)
        self.durations.append(max(20, round(seconds * TICKS)))
        self.ticks += self.durations[-1]

    def close(self) -> None:
        first, *others = self.pictures
        first.save(
            self.path, save_all=True, append_images=others, duration=self.durations, loop=0, quality=80
        )  # GIF ignores these options

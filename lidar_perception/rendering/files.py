"""Writer of images and videos: PNG, GIF and WebP with Pillow, MP4 with PyAV (extra [video])."""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import numpy as np
from PIL import Image, PngImagePlugin

from lidar_perception.runs.files import write_bytes
from lidar_perception.types import InputError

VIDEO_SUFFIXES, ANIMATION_SUFFIXES = (".mp4", ".mkv", ".mov"), (".gif", ".webp")
ANIMATED_WIDTH = 960  # maximum width and height of an animation in pixels
MAX_ANIMATED = 300  # maximum number of frames of an animation, which are held in memory
TICKS = 1000  # time base of videos in ticks per second
PNG_KEY, PNG_LEVEL = "lidar_perception", 3  # key of the note in PNG files, and compression level
QUALITY = {"crf": "20", "preset": "veryfast"}  # options of the H.264 encoder


def write_png(path: Path, image: np.ndarray, note: str = "") -> None:
    """Write an image (height, width, 3) uint8 with a note. Raise InputError if the file cannot be written."""
    info, stream = PngImagePlugin.PngInfo(), io.BytesIO()
    info.add_text(PNG_KEY, note)
    Image.fromarray(image).save(stream, "png", pnginfo=info, compress_level=PNG_LEVEL)
    write_bytes(path, stream.getbuffer())


def read_png_note(path: Path) -> str | None:
    """Return the note that write_png wrote to a PNG file; None if the file has no note."""
    try:
        with Image.open(path) as image:
            return image.info.get(PNG_KEY)
    except OSError:
        return None


def check_video(path: Path, count: int) -> None:
    """Raise InputError if a video of `count` frames cannot be written to a path."""
    if path.suffix not in (*VIDEO_SUFFIXES, *ANIMATION_SUFFIXES):
        raise InputError(
            f"{path} is not a video file; use one of the suffixes {', '.join((*VIDEO_SUFFIXES, *ANIMATION_SUFFIXES))}"
        )
    if path.suffix in VIDEO_SUFFIXES and importlib.util.find_spec("av") is None:
        raise InputError(f"{path} needs PyAV; run pip install 'lidar_perception[video]', or write a .gif or .webp file")
    if path.suffix in ANIMATION_SUFFIXES and count > MAX_ANIMATED:
        raise InputError(
            f"{path} would have {count} frames; {path.suffix} files are limited to "
            f"{MAX_ANIMATED}: use --limit, or write an .mp4 file"
        )


@contextmanager
def open_video(path: Path, size: tuple[int, int]) -> Iterator[VideoFile]:
    """Open a video with frames of a size (width, height) for writing.

    The file appears when it is complete. No file is written if no frame is added.

    Raises:
        InputError: The video cannot be written.
    """
    partial = path.with_name(f".{path.stem}.incomplete{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        writer: VideoFile = _H264File(partial, size) if path.suffix in VIDEO_SUFFIXES else _AnimationFile(partial)
        yield writer
        if writer.ticks:
            writer.close()
            partial.replace(path)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from None
    finally:
        partial.unlink(missing_ok=True)


class _H264File:
    """H.264 video; frames are cropped to an even width and height."""

    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        import av

        self.av = av
        self.container = av.open(str(path), "w")
        self.stream = self.container.add_stream("libx264", rate=30, options=QUALITY)
        self.stream.width, self.stream.height = (side - side % 2 for side in size)
        self.stream.pix_fmt = "yuv420p"
        self.stream.codec_context.time_base = Fraction(1, TICKS)
        self.ticks = 0

    def add(self, image: np.ndarray, seconds: float) -> None:
        """Add an image (height, width, 3) uint8 as a frame that is shown for `seconds`."""
        frame = self.av.VideoFrame.from_ndarray(
            np.ascontiguousarray(image[: self.stream.height, : self.stream.width]), format="rgb24"
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
        self.frames: list[Image.Image] = []
        self.durations: list[int] = []  # frame durations in milliseconds

    def add(self, image: np.ndarray, seconds: float) -> None:
        """Add an image (height, width, 3) uint8 as a frame that is shown for `seconds`."""
        frame = Image.fromarray(image)
        frame.thumbnail((ANIMATED_WIDTH, ANIMATED_WIDTH), Image.Resampling.LANCZOS)
        if self.path.suffix == ".gif":
            frame = frame.quantize(128, dither=Image.Dither.NONE)
        self.frames.append(frame)
        self.durations.append(max(20, round(seconds * TICKS)))
        self.ticks += self.durations[-1]

    def close(self) -> None:
        first, *others = self.frames
        first.save(self.path, save_all=True, append_images=others, duration=self.durations, loop=0, quality=80)


VideoFile = _H264File | _AnimationFile

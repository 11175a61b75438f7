"""Draw the pictures of the README and the docs from simulated scans: python docs/picture.py"""

from __future__ import annotations

import tempfile
from contextlib import suppress
from pathlib import Path

from PIL import Image, ImageSequence

from lidar_perception.cli.main import cli

FOLDER = Path(__file__).parent / "images"
SEED = 9
FILM_SIZE, FILM_PERIOD_MS = (720, 405), 100
SENSORS, SENSOR_SIZE = ("Pandar64", "OS1-64", "HDL-32E", "VLP-16"), (800, 450)


def detect_in_drive(folder: Path, simulation: list[str], detection: list[str], name: str = "drive") -> None:
    """Simulate a drive `folder`/`name` and run `detect` on it; results are in `folder`/out."""
    drive = str(folder / name)
    for words in (
        ["simulate", "--out", drive, *simulation],
        ["detect", drive, "--out", str(folder / "out"), *detection],
    ):
        with suppress(SystemExit):
            cli(words, standalone_mode=False)


def draw_detect(path: Path) -> None:
    """Draw the last frame of a simulated drive by `detect --track --png`."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        detect_in_drive(folder, ["--frames", "20", "--seed", "4"], ["--track", "--png"])
        path.write_bytes(sorted((folder / "out/png").rglob("*.png"))[-1].read_bytes())


def draw_film(path: Path) -> None:
    """Draw a simulated drive by `detect --track --video`, reduced to the size of the README."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        detect_in_drive(
            folder,
            ["--frames", "40", "--seed", str(SEED), "--kind", "zone", "--people", "2"],
            ["--track", "--range", "around", "--video", str(folder / "film.webp")],
        )
        with Image.open(folder / "film.webp") as film:
            frames = [
                frame.convert("RGB").resize(FILM_SIZE, Image.Resampling.LANCZOS)
                for frame in ImageSequence.Iterator(film)
            ]
        frames[0].save(
            path, save_all=True, append_images=frames[1:], duration=FILM_PERIOD_MS, loop=0, quality=40, method=4
        )


def draw_sensors(path: Path) -> None:
    """Draw a scan of the same street by each of SENSORS, with labels and detections, by `detect --png`."""
    width, height = SENSOR_SIZE
    picture = Image.new("RGB", (2 * width, 2 * height))
    for i, sensor in enumerate(SENSORS):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            detect_in_drive(
                folder,
                ["--sensor", sensor, "--frames", "1", "--seed", str(SEED), "--kind", "zone", "--people", "3"],
                ["--range", "around", "--png"],
                sensor,
            )
            (drawing,) = (folder / "out/png").rglob("*.png")
            with Image.open(drawing) as frame:
                reduced = frame.convert("RGB").resize(SENSOR_SIZE, Image.Resampling.LANCZOS)
            picture.paste(reduced, (i % 2 * width, i // 2 * height))
    picture.save(path, quality=75, method=6)


def make(folder: Path = FOLDER) -> None:
    """Write all pictures."""
    draw_detect(folder / "detect.png")
    draw_film(folder / "detect.webp")
    draw_sensors(folder / "sensors.webp")


if __name__ == "__main__":
    make()

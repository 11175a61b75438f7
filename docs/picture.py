"""Draw the pictures of the README and the docs from simulated scans: python docs/picture.py"""

from __future__ import annotations

import tempfile
from contextlib import suppress
from pathlib import Path

import numpy as np
from PIL import Image, ImageSequence

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import find_candidates
from lidar_perception.candidates.seed_sources import make_fixed_source
from lidar_perception.candidates.seeds import load_seeds
from lidar_perception.cli.main import cli
from lidar_perception.clustering.cluster import cluster
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.pointpillars.params import DetectorParams
from lidar_perception.ground.segment import segment_ground
from lidar_perception.rendering.canvas import Canvas
from lidar_perception.rendering.colors import BACKGROUND, color_by_cluster
from lidar_perception.rendering.files import write_png
from lidar_perception.rendering.picture import Boxes, RenderSettings, draw_view, highlight_points
from lidar_perception.rendering.views import Perspective
from lidar_perception.simulation.drive import simulate_scan
from lidar_perception.simulation.scene import Scenes
from lidar_perception.simulation.sensor import HDL64E
from lidar_perception.types import Detections

FOLDER = Path(__file__).parent / "images"
SEED, STREETS = 9, Scenes("zone", people=3.0)
FINER = 2  # pictures are drawn at twice their size and reduced, for smooth points
README = Perspective((-9.0, -4.5, 5.2), (14.0, 1.6, -0.9), 58.0, 1600 * FINER, 720 * FINER)
LOOK = Perspective((-12.0, -6.0, 8.0), (12.0, 1.0, -1.2), 60.0, 1600 * FINER, 800 * FINER)
FILM_SIZE, FILM_PERIOD_MS = (720, 405), 100
SENSORS, SENSOR_SIZE = ("Pandar64", "OS1-64", "HDL-32E", "VLP-16"), (800, 450)


def draw(path: Path, view: Perspective, xyz: np.ndarray, colors: np.ndarray, found: Detections) -> None:
    """Draw a cloud with boxes, without texts."""
    boxes = Boxes(found.boxes, found.class_ids)
    canvas = Canvas(view.width, view.height, BACKGROUND)
    colors = highlight_points(colors, xyz, boxes)
    draw_view(canvas, view, RenderSettings(50.0, True, -1.73), xyz, colors, boxes)
    write_png(path, np.asarray(Image.fromarray(canvas.pixels).reduce(FINER)))


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
    """Simulate scans, run the package on them, and write the pictures."""
    frame = simulate_scan(SEED, 0, HDL64E, STREETS).frame
    params = DetectorParams()
    found = open_detector("pointpillars")(frame).detections
    ground = segment_ground(frame, params.ground)
    cluster_ids = np.zeros(len(frame), np.int32)
    cluster_ids[~ground] = cluster(frame.xyz[~ground], params.clustering)
    draw(folder / "scene.png", README, frame.xyz, color_by_cluster(ground, cluster_ids), found)

    # Default displays of the layouts: clusters, ground, detections and candidates.
    segmented, candidates = find_candidates(frame, make_fixed_source(*load_seeds(PipelineParams().seed.file)))
    draw(
        folder / "look.png",
        LOOK,
        segmented.xyz,
        color_by_cluster(segmented.ground, segmented.cluster_ids),
        found.concatenate(candidates.final),
    )
    draw_detect(folder / "detect.png")
    draw_film(folder / "detect.webp")
    draw_sensors(folder / "sensors.webp")


if __name__ == "__main__":
    make()

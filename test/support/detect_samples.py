"""Stand-in detector without a network, and runs of `detect` with it."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace

import numpy as np
from cli_samples import read_error_line, run_main

from lidar_perception.detecting.formats import Run
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.param_fields import Params, param
from lidar_perception.types import CLASSES, Detections

NAME = "made"  # name that opens the detector
CAR, PEDESTRIAN = CLASSES.index("Car"), CLASSES.index("Pedestrian")
WEAK, STRONG = 0.15, 0.876543


@dataclass(frozen=True)
class MadeParams(Params):
    """Parameters of MadeDetector."""

    least: float = param(0.5, "Least score.", low=0.0, high=1.0)


class MadeDetector:
    """Detector that finds a walker, and a car with a low score that differs between clouds. calls: clouds passed to
    any instance; fails(scan): called before each detection, may raise."""

    classes = ("Car", "Pedestrian")
    calls: list = []
    problem = None

    def __init__(self, params=MadeParams(), fails=lambda scan: None):
        self.params, self.fails = params, fails

    @property
    def min_scores(self):
        return dict.fromkeys(self.classes, self.params.least)

    def with_min_score(self, min_score):
        return MadeDetector(replace(self.params, least=min_score), self.fails)

    def with_sensor_height(self, height):
        return self

    def with_range(self, range):
        return self

    def __call__(self, frame, **columns):
        self.fails(frame)
        self.calls.append(frame)
        mean = float(frame.xyz[:50].mean())
        boxes = [[8.0, 0.5, -0.85, 0.5, 0.5, 1.7, 0.3], [14.0 + mean, -3, -1, 4, 1.7, 1.5, -3.1]]
        detections = Detections.of(boxes, [PEDESTRIAN, CAR], [STRONG, WEAK + abs(mean) / 1e3])
        detections = replace(detections, sources={"a": np.array([0.5, np.nan], np.float32)})
        problem = f"{len(frame)} points are few" if frame.xyz[0, 0] > 0 else None
        return DetectionResult(detections[detections.scores >= self.params.least], problem=problem)


def load_made_detector(path="", device="auto"):
    """Load the detector, like the loaders in detectors.open.LOAD."""
    return MadeDetector()


def detect(monkeypatch, *arguments):
    """Return the exit code of `detect --weights made ARGUMENTS`."""
    return run_main(monkeypatch, "detect", "--weights", NAME, *arguments)


def detect_with_error(monkeypatch, capsys, *arguments):
    """Return the error line of an invalid call."""
    assert detect(monkeypatch, *arguments) == 2
    return read_error_line(capsys)


def read_json(out):
    """Return detections.json without the times."""
    content = json.loads((out / "detections.json").read_text())
    for frame in content["frames"]:
        assert frame.pop("ms") >= 0
    return content


def list_objects(content):
    """Return {frame: rows of numbers of its objects}."""
    return {
        frame["name"]: [
            [
                CLASSES.index(row["class"]),
                row["score"],
                *(row[name] for name in ("x", "y", "z", "length", "width", "height", "yaw")),
            ]
            for row in frame["objects"]
        ]
        for frame in content["frames"]
    }


def make_run(recording, out, **header):
    return Run(recording, out, {"detector": NAME, "min_scores": {}, **header}, len(recording))

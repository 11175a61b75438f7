"""Parameters that all detectors with networks share, and the base class of detectors with parameters."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from lidar_perception.ground.params import set_sensor_height
from lidar_perception.param_fields import Params, param
from lidar_perception.types import CLASSES, Detections

MIN_SCORE = 0.001  # threshold for computing average precision, which also needs boxes with low scores
RANGE_CHOICES = "auto", "ahead", "around"


@dataclass(frozen=True)
class ScoreParams(Params):
    """Minimum score of a detection by class. Scores are probabilities, see calibration.py."""

    car: float = param(0.4, "Minimum score of a Car.", low=0.0, high=1.0)
    pedestrian: float = param(0.4, "Minimum score of a Pedestrian.", low=0.0, high=1.0)
    cyclist: float = param(0.4, "Minimum score of a Cyclist.", low=0.0, high=1.0)
    other: float = param(0.4, "Minimum score of any other class of the weights.", low=0.0, high=1.0)

    @staticmethod
    def for_all_classes(score: float) -> ScoreParams:
        """Make parameters with the same threshold for all classes."""
        return ScoreParams(score, score, score, score)

    def limit_to(self, score: float) -> ScoreParams:
        """Return these thresholds, each at most `score`."""
        return ScoreParams(*(min(value, score) for value in vars(self).values()))

    def get(self, name: str) -> float:
        """Return the threshold of a class of types.CLASSES."""
        return getattr(self, name.lower(), self.other)

    def get_all(self, names: Iterable[str]) -> dict[str, float]:
        """Return the thresholds of several classes by name."""
        return {name: self.get(name) for name in names}

    def passes(self, detections: Detections) -> np.ndarray:
        """Return a mask (K,) bool of the detections that reach the threshold of their class."""
        min_scores = np.array([self.get(name) for name in CLASSES], np.float32)
        return detections.scores >= min_scores[detections.class_ids]


@dataclass(frozen=True)
class NmsParams(Params):
    """Non-maximum suppression: of boxes that overlap in the bird's-eye view, keep the best one."""

    iou: float = param(0.1, "Drop a box if its bird's-eye-view IoU with a better one is above this.", low=0.0, high=1.0)
    across_classes: bool = param(False, "Boxes of different classes suppress each other too.")
    candidates: int = param(500, "Maximum number of boxes before NMS; the best scores are kept.", low=1, high=10_000)
    max_boxes: int = param(100, "Maximum number of boxes after NMS; the best scores are kept.", low=1, high=10_000)


def make_range_param() -> Any:
    """Return the parameter `range` of detectors with PointPillars."""
    return param(
        "auto",
        "Covered area. ahead: 69.12 m ahead and 39.68 m to each side; around: 51.2 m in all directions (a network "
        "trained for `ahead` runs twice per cloud); auto: the area that the weights were trained for.",
        choices=RANGE_CHOICES,
        fixed=True,
    )


def make_amp_param() -> Any:
    """Return the parameter `amp` of detectors with PointPillars."""
    return param(
        "off",
        "Number format of PointPillars' layers. off: float32. auto: 16 bits (bf16, on older GPUs fp16) if the device "
        "has instructions for it: half the time, slightly different scores. bf16: on every device.",
        choices=("off", "auto", "bf16"),
        fixed=True,
    )


def make_engine_param(other_networks: str = "") -> Any:
    """Return the parameter `engine` of detectors with PointPillars.

    The description ends with `other_networks`, a text about other networks of the detector.
    """
    return param(
        "auto",
        "Implementation of PointPillars' layers on the CPU. sparse: kernels that compute only cells near points; needs "
        "a version without ground (v1, v2, v4), x86-64 with AVX2, and amp off. torch: all cells. auto: sparse if "
        "possible. Detections are the same." + other_networks,
        choices=("auto", "torch", "sparse"),
        fixed=True,
    )


def make_on_points_param() -> Any:
    """Return the parameter `on_points` of detectors that move the boxes of cars to their points."""
    return param(
        0.75,
        "Align the visible faces of cars with their points. 0: keep the box, 1: move it all the way.",
        low=0.0,
        high=1.0,
    )


@dataclass(frozen=True)
class NetworkParams(Params):
    """Device of a detector's network, and thresholds for its detections."""

    weights: str = param("", "Checkpoint (.safetensors); empty: the shipped one.", fixed=True)
    device: str = param("auto", "cpu, cuda or cuda:N; auto: CUDA if available.", fixed=True)
    threads: int = param(
        0,
        "CPU threads of the network; fewer leave room for other programs. 0: one per core.",
        low=0,
        high=1024,
        fixed=True,
    )
    cpu_fallback: bool = param(
        True, "Fall back to the CPU when CUDA runs out of memory; in a node also when there is no CUDA device."
    )
    warm_up: bool = param(True, "Run once on synthetic points before the first cloud.", fixed=True)
    use_intensity: bool = param(
        True, "Use the intensity, normalized so that gain and scale of the sensor have no effect. false: ignore it."
    )
    scores: ScoreParams = ScoreParams()
    nms: NmsParams = NmsParams()


class ConfiguredDetector:
    """Base class of detectors with parameters.

    Attributes:
        params: parameters of the detector's node, a dataclass of groups such as crop and ground.
        group: name of the group with the detector's own parameters, among them the scores.
    """

    params: Any
    group: str

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the detectable classes."""
        raise NotImplementedError

    @property
    def settings(self) -> Any:
        """Parameter group with the detector's own parameters."""
        return getattr(self.params, self.group)

    @property
    def min_scores(self) -> dict[str, float]:
        """Score threshold of each class, 0..1."""
        return self.settings.scores.get_all(self.classes)

    def with_params(self, params: Any) -> Self:
        """Return a copy of this detector with different parameters."""
        other = copy.copy(self)
        other.params = params
        return other

    def with_min_score(self, min_score: float) -> Self:
        """Return a copy of this detector with one threshold for all classes."""
        settings = replace(self.settings, scores=ScoreParams.for_all_classes(min_score))
        return self.with_params(replace(self.params, **{self.group: settings}))

    def with_sensor_height(self, height: float) -> Self:
        """Return a copy of this detector for a sensor `height` metres above the ground."""
        return self.with_params(set_sensor_height(self.params, height))

"""What every detector with a network is told: where it runs, and what counts as a detection."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from lidar_perception.param_fields import Params, param
from lidar_perception.types import CLASSES, Detections

MIN_SCORE = 0.001  # of boxes that average precision is made of: more than a robot would act on
RANGE_CHOICES = "auto", "ahead", "around"


@dataclass(frozen=True)
class ScoreParams(Params):
    """The least score of a detection, by class: a probability, see calibration.py."""

    car: float = param(0.4, "Minimum score of a Car.", low=0.0, high=1.0)
    pedestrian: float = param(0.4, "Minimum score of a Pedestrian.", low=0.0, high=1.0)
    cyclist: float = param(0.4, "Minimum score of a Cyclist.", low=0.0, high=1.0)
    other: float = param(0.4, "Minimum score of any other class of the weights.", low=0.0, high=1.0)

    @staticmethod
    def all_alike(score: float) -> ScoreParams:
        """One threshold for every class."""
        return ScoreParams(score, score, score, score)

    def at_most(self, score: float) -> ScoreParams:
        """These thresholds, but none above score."""
        return ScoreParams(*(min(value, score) for value in vars(self).values()))

    def of_class(self, name: str) -> float:
        """The threshold of a class of types.CLASSES."""
        return getattr(self, name.lower(), self.other)

    def of_classes(self, names: Iterable[str]) -> dict[str, float]:
        """The thresholds of several classes by name."""
        return {name: self.of_class(name) for name in names}

    def passed(self, detections: Detections) -> np.ndarray:
        """(K,) bool: which of K detections reach the threshold of their class."""
        least = np.array([self.of_class(name) for name in CLASSES], np.float32)
        return detections.scores >= least[detections.class_ids]


@dataclass(frozen=True)
class NmsParams(Params):
    """Non-maximum suppression: of boxes that overlap, seen from above, the best stays."""

    iou: float = param(0.1, "A box whose overlap with a better one exceeds this is dropped.",
                       low=0.0, high=1.0)
    across_classes: bool = param(False, "Boxes of different classes suppress each other too.")
    candidates: int = param(500, "Only this many boxes, those with the highest scores, take part.",
                            low=1, high=10_000)
    max_boxes: int = param(100, "At most this many boxes are kept, those with the highest scores.",
                           low=1, high=10_000)


def seen_range() -> Any:
    """The parameter of detectors with PointPillars that says what they see."""
    return param("auto", "What it sees. ahead: 69.12 m ahead and 39.68 m to each side; around: "
                 "51.2 m to every side, in two looks of a network that was trained ahead. auto: "
                 "what the weights were trained for.", choices=RANGE_CHOICES,
                 fixed=True)


def layers_format() -> Any:
    """The parameter of detectors with PointPillars that says in which numbers its layers work."""
    return param("off", "Number format of PointPillars' layers. off: float32. auto: 16 bits (bf16, "
                 "on older GPUs fp16) where the device has instructions for it, so that they take "
                 "half the time; scores differ a little. bf16: wherever it runs.",
                 choices=("off", "auto", "bf16"), fixed=True)


def network_engine(more: str = "") -> Any:
    """Return the parameter of detectors with PointPillars that chooses what runs its layers; more:
    a sentence on the detector's other network."""
    return param("auto", "What runs PointPillars' layers on the CPU. sparse: kernels that compute "
                 "only the cells near points, for versions without ground (v1, v2, v4), x86-64 "
                 "with AVX2 and amp off. torch: all cells. auto: sparse where it can. Detections "
                 "are the same." + more, choices=("auto", "torch", "sparse"), fixed=True)


def share_on_points() -> Any:
    """The parameter of detectors that put cars where their points are."""
    return param(0.75, "How far cars are moved so that their points begin at the faces that are "
                 "seen; 0: not at all.", low=0.0, high=1.0)


@dataclass(frozen=True)
class NetworkParams(Params):
    """Where a detector's network runs, and what counts as a detection."""

    weights: str = param("", "Checkpoint (.safetensors); empty: the one that comes with the "
                         "package.", fixed=True)
    device: str = param("auto", "cpu, cuda or cuda:N; auto: CUDA where there is one.", fixed=True)
    threads: int = param(0, "CPU threads of the network; fewer leave room for other programs. "
                         "0: one for each core.", low=0, high=1024, fixed=True)
    cpu_fallback: bool = param(True, "Fall back to the CPU when CUDA runs out of memory; in a "
                                     "node also when there is no CUDA device.")
    warm_up: bool = param(True, "Run once on synthetic points before the first cloud.", fixed=True)
    intensity_scale: float = param(1.0, "The intensity (0..1) is multiplied by this, for a sensor "
                                        "that reports more or less than the one trained on; 0 "
                                   "leaves the intensity out.", low=0.0, high=1000.0)
    scores: ScoreParams = ScoreParams()
    nms: NmsParams = NmsParams()

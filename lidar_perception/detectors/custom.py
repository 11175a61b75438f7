"""Custom detectors: any class whose instances return Detections for a cloud."""

from __future__ import annotations

import importlib
import inspect
import os
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.metadata import entry_points
from pathlib import Path
from time import perf_counter
from typing import Any, cast

import numpy as np

from lidar_perception.classes import DETECTED
from lidar_perception.detectors.contract import Cloud, DetectionResult, Detector, check_input
from lidar_perception.detectors.params import ConfiguredDetector, ScoreParams
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.param_fields import Params
from lidar_perception.robot.params import CropParams
from lidar_perception.types import (
    CLASSES,
    Detections,
    InputError,
    PointCloud,
    RunError,
    make_unknown_name_error,
    suggest_name,
)

ENTRY_POINTS = "lidar_perception.detectors"  # group of entry points: NAME = "module:Class"
REFERENCE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")
ARGUMENTS = "sensor_height", "device", "range"  # keyword arguments passed to a class that accepts them


@dataclass(frozen=True)
class MountParams(Params):
    """Mounting pose of the sensor."""

    sensor_pose: SensorPoseParams = SensorPoseParams()


@dataclass(frozen=True)
class CustomParams(Params):
    """Score thresholds of a custom detector."""

    scores: ScoreParams = ScoreParams.for_all_classes(0.0)


@dataclass(frozen=True)
class CustomDetectorParams:
    """Parameter groups of a custom detector, without the settings of the class itself."""

    crop: CropParams = CropParams()
    ground: MountParams = MountParams()
    custom: CustomParams = CustomParams()


@dataclass
class CustomDetector(ConfiguredDetector):
    """Adapter that makes a contract.Detector from a function that returns Detections for a cloud.

    Attributes:
        name: name of the detector in messages.
        build: function that returns the detection function for a sensor height in metres.
        classes: names of the detectable classes.
        device: device name shown in the status of a node.
    """

    name: str
    build: Callable[[float], Callable[[PointCloud], Any]]
    classes: tuple[str, ...] = tuple(DETECTED)
    params: Any = field(default_factory=CustomDetectorParams)
    group: str = "custom"
    device: str = "auto"

    def __call__(
        self, cloud: Cloud, *, ground: np.ndarray | None = None, cluster_ids: np.ndarray | None = None
    ) -> DetectionResult:
        """Detect the objects in a cloud, see contract.Detector; ground and cluster_ids are checked but not used.

        Raises:
            RunError: the function did not return Detections.
        """
        frame, _, _, problem = check_input(cloud, ground, cluster_ids)
        pose = self.params.ground.sensor_pose
        if self.params.crop.enabled:
            from lidar_perception.ground.segment import crop_with_sensor_pose  # loads Numba

            _, frame = crop_with_sensor_pose(frame, self.params.crop, pose)
        begin = perf_counter()
        detections = self.build(pose.height)(frame)
        milliseconds = (perf_counter() - begin) * 1e3
        if not isinstance(detections, Detections):
            raise RunError(
                f"{self.name} returned {type(detections).__name__} instead of Detections, such as "
                "lidar_perception.Detections.of(boxes, class_ids, scores)"
            )
        return DetectionResult(detections[self.settings.scores.passes(detections)], {"detect": milliseconds}, problem)


def as_detector(detector: Detector | Callable[[PointCloud], Detections]) -> Detector:
    """Return a Detector unchanged, and wrap any other function of a cloud in a CustomDetector.

    Raises:
        InputError: the argument is not callable, or is a class instead of an instance.
    """
    if isinstance(detector, type) or not callable(detector):
        raise InputError(f"{detector!r} is not a detector; give an instance with __call__(cloud) -> Detections")
    if hasattr(detector, "with_min_score") and hasattr(detector, "min_scores"):
        return cast(Detector, detector)
    name = getattr(detector, "__name__", type(detector).__name__)
    return CustomDetector(name, lambda height: detector, _find_classes(name, detector))


def find_reference(name: str) -> str | None:
    """Return "module:Class" for a reference or an entry point name; None for other names."""
    if REFERENCE.fullmatch(name):
        return None if Path(name).exists() else name
    return next((entry.value for entry in entry_points(group=ENTRY_POINTS) if entry.name == name), None)


def entry_point_names() -> list[str]:
    """Return the sorted names of the detectors that other packages provide."""
    return sorted({entry.name for entry in entry_points(group=ENTRY_POINTS)})


def load_custom_detector(
    reference: str, device: str = "auto", range: str = "auto", params: Any = None, group: str = "custom"
) -> CustomDetector:
    """Load a custom detector, a class whose instances return Detections for a PointCloud.

    Args:
        reference: "module:Class". The module is on Python's path or in the current folder.
        device, range: arguments for the class, passed if it accepts them; so is sensor_height, in
            metres, from `params`.
        params, group: see CustomDetector. Default: CustomDetectorParams.

    Raises:
        InputError: the module or class is missing or fails, or the class has no argument `range`.
    """
    detector_class = _find_class(reference)
    supported_names = _find_arguments(detector_class)
    if range != "auto" and "range" not in supported_names:
        raise InputError(f"{reference} has no argument `range`; omit the range, or add the argument to the class")
    arguments = {name: value for name, value in (("device", device), ("range", range)) if name in supported_names}

    @lru_cache(maxsize=2)
    def build(height: float | None) -> Callable[[PointCloud], Any]:
        height_argument = {} if height is None else {"sensor_height": height}
        try:
            detector = detector_class(**arguments, **height_argument)
        except Exception as error:
            raise InputError(f"cannot create {reference}: {_describe(error)}") from error
        if not callable(detector):
            raise InputError(f"{reference} has no method __call__(cloud) -> Detections")
        return detector

    takes_height = "sensor_height" in supported_names
    params = CustomDetectorParams() if params is None else params
    detector = build(params.ground.sensor_pose.height if takes_height else None)
    return CustomDetector(
        reference,
        lambda height: build(height if takes_height else None),
        _find_classes(reference, detector),
        params,
        group,
        device,
    )


def _find_class(reference: str) -> Callable[..., Any]:
    module_name, _, class_name = reference.partition(":")
    if (folder := os.getcwd()) not in sys.path:
        sys.path.append(folder)  # `python -m` does this itself, but console scripts do not
    try:
        value: Any = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise InputError(f"cannot import {module_name}: {_describe(error)}") from error
        raise InputError(
            f"no module named {module_name!r}; run the command in its folder, or add its folder to PYTHONPATH"
        ) from None
    except Exception as error:
        raise InputError(f"cannot import {module_name}: {_describe(error)}") from error
    for name in class_name.split("."):
        if not hasattr(value, name):
            class_names = [key for key, candidate in vars(value).items() if isinstance(candidate, type)]
            raise InputError(f"{module_name} has no class {class_name!r}{suggest_name(class_name, class_names)}")
        value = getattr(value, name)
    if not callable(value):
        raise InputError(f"{reference} is of type {type(value).__name__}, not a class")
    return value


def _find_arguments(detector_class: Callable[..., Any]) -> set[str]:
    """Return the ARGUMENTS that a class accepts as keywords."""
    try:
        parameters = inspect.signature(detector_class).parameters
    except ValueError:  # the class is written in C
        return set()
    return {
        name
        for name in ARGUMENTS
        if name in parameters and parameters[name].kind is not inspect.Parameter.POSITIONAL_ONLY
    }


def _find_classes(name: str, detector: Any) -> tuple[str, ...]:
    """Return the attribute `classes` of a detector; default: all classes."""
    classes = tuple(getattr(detector, "classes", DETECTED))
    for class_name in classes:
        if class_name not in CLASSES:
            raise make_unknown_name_error(f"class of {name}", class_name, CLASSES)
    return classes


def _describe(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"

"""What detectors with a network share: their parameters, the device, and what takes over."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any, Self, TypeVar

import numpy as np
import torch

from lidar_perception.detectors.calibration import raw_score
from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.contract import Cloud, Found, accept, joined
from lidar_perception.detectors.devices import CPU
from lidar_perception.detectors.params import NetworkParams, ScoreParams
from lidar_perception.ground.params import set_sensor_height
from lidar_perception.ground.segment import crop_with_sensor_pose
from lidar_perception.intensity import MIN_POINTS
from lidar_perception.types import InputError, LidarFrame

Result = TypeVar("Result")


@dataclass
class Place:
    """Where a network runs; fallback: why the CPU took over, or None. All detectors of the network
    share it."""

    device: torch.device
    fallback: str | None = None


class NetworkDetector:
    """Base of the detectors. params, their parameters, may be replaced at any time."""

    def __init__(self, header: Header, device: torch.device, params: Any):
        self.header, self.config, self.params = header, header.config, params
        self.place = Place(device)
        self.doubt: str | None = None  # of its scores, or of its classes

    def __call__(self, cloud: Cloud, *, ground: np.ndarray | None = None,
                 cluster_ids: np.ndarray | None = None) -> Found:
        """See contract.Detector. InputError also where CUDA is out of memory and the CPU may not
        take over."""
        frame, ground, cluster_ids, problem = accept(cloud, ground, cluster_ids,
                                                     self.settings.intensity_scale)
        if self.params.crop.enabled:
            kept, frame = crop_with_sensor_pose(frame, self.params.crop,
                                                self.params.ground.sensor_pose)
            ground, cluster_ids = (column if column is None else column.take(kept)
                                   for column in (ground, cluster_ids))
        found = self.detect(frame, ground, cluster_ids)
        return replace(found, problem=joined(problem, found.problem)) if problem else found

    def detect(self, frame: LidarFrame, ground: np.ndarray | None,
               cluster_ids: np.ndarray | None) -> Found:
        """The objects in a frame that is cropped."""
        raise NotImplementedError

    @property
    def group(self) -> str:
        """The group of params that is its own: where it runs, and what counts as a detection."""
        return self.header.network

    @property
    def settings(self) -> NetworkParams:
        """The detector's own group of params."""
        return getattr(self.params, self.group)

    @property
    def device(self) -> torch.device:
        """Where the network runs now."""
        return self.place.device

    @property
    def fallback(self) -> str | None:
        """Why the CPU took over, or None."""
        return self.place.fallback

    @property
    def classes(self) -> tuple[str, ...]:
        """What it was trained to detect."""
        return self.config.classes

    @property
    def min_scores(self) -> dict[str, float]:
        """By class, the least score of a detection."""
        return {name: self.settings.scores.of_class(name) for name in self.classes}

    @property
    def range(self) -> str:
        """What the detector covers: "ahead" of the sensor only, or all "around" it."""
        low = getattr(self.config, "low", None)  # only some networks have a range
        return "around" if low is None or low[0] < 0 else "ahead"

    def raw_min_scores(self) -> list[float]:
        """The same in the order of classes, before calibration."""
        return [raw_score(name, score, self.header.calibration)
                for name, score in self.min_scores.items()]

    def raw(self) -> Self:
        """The same detector, of the same network, with the network's own scores."""
        other = copy.copy(self)
        other.header = replace(self.header, calibration={})
        return other

    def with_range(self, range: str) -> Self:
        """Return this detector, with the same network, for another range: ahead, around, or auto,
        what its weights were trained for. A network without such a range always sees all
        around. InputError where the network cannot see that range."""
        if range == "ahead":
            raise InputError(f"{self.header.network} sees all around; crop.* leaves out what is "
                             "not wanted")
        return self

    def with_min_score(self, min_score: float) -> Self:
        """The same detector, of the same network, with this least score for every class."""
        other = copy.copy(self)
        settings = replace(self.settings, scores=ScoreParams.all_alike(min_score))
        other.params = replace(self.params, **{self.group: settings})
        return other

    def mounted_at(self, height: float) -> Self:
        """The same detector, of the same network, for a sensor so many metres above the ground."""
        other = copy.copy(self)
        other.params = set_sensor_height(self.params, height)
        return other

    def bring_to(self, device: torch.device) -> None:
        """Bring the network, and what it needs, to a device."""
        raise NotImplementedError

    def move(self, device: torch.device) -> None:
        """Run on another device from now on, or on the CPU if it is out of memory."""
        self.place.device = device
        try:
            self.bring_to(device)
        except torch.cuda.OutOfMemoryError as error:
            self._fall_back(error)

    def guarded(self, work: Callable[[], Result]) -> Result:
        """What work() gives; once more on the CPU if the device is out of memory. InputError
        where the CPU may not take over."""
        try:
            return work()
        except torch.cuda.OutOfMemoryError as error:
            self._fall_back(error)
            return work()

    def _fall_back(self, error: Exception) -> None:
        if self.device == CPU or not self.settings.cpu_fallback:
            raise InputError(f"{self.device} is out of memory; use the CPU or a smaller network"
                             ) from error
        self.place.fallback = (f"{self.device} is out of memory, so the network runs on the CPU; "
                               "close other programs and start again")
        self.move(CPU)

    def now(self) -> float:
        """Seconds of a clock, after what the device has been asked to do is done."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return perf_counter()

    def no_intensity(self, frame: LidarFrame) -> str | None:
        """Say that the network misses the intensity of a frame; None where there is one, or it
        shall not be read."""
        if not self.settings.intensity_scale or (frame.intensity is not None and (
                len(frame) < MIN_POINTS or frame.intensity.any())):
            return None
        lack = "has no intensity" if frame.intensity is None else "has the intensity 0 everywhere"
        return f"the cloud {lack}, which the network was trained with; it reads zeros"

    def nothing_passed(self, highest: Iterable[float]) -> tuple[dict[str, float], str | None]:
        """The highest score of each class, where none reached its threshold, and what is wrong if
        they are no numbers."""
        best = dict(zip(self.classes, highest))
        broken = any(map(math.isnan, best.values()))
        return best, ("the network's scores are not numbers (NaN); the weights or the intensity "
                      "are broken" if broken else None)

"""Base class of trained networks that run on a device and fall back to the CPU."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any, Self, TypeVar

from lidar_perception.detectors.calibration import to_raw_score
from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.devices import CPU, is_out_of_memory
from lidar_perception.types import InputError

Result = TypeVar("Result")


@dataclass
class Placement:
    """Device of a network, shared by all copies of a TrainedNetwork.

    Attributes:
        fallback: reason why the network runs on the CPU instead of the chosen device, or None.
    """

    device: str
    fallback: str | None = None


class TrainedNetwork:
    """A network in inference mode with its header and device.

    Args:
        network: network with a method to(device), see the Protocol of each type of network.
    """

    def __init__(self, network: Any, header: Header, device: str = CPU):
        self.network, self.header = network, header
        self.placement = Placement(device)

    @property
    def config(self) -> Any:
        """The config of the network, such as NetworkConfig or PointNetConfig."""
        return self.header.config

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the detectable classes."""
        return self.config.classes

    @property
    def device(self) -> str:
        return self.placement.device

    def with_raw_scores(self) -> Self:
        """Return a copy that reports uncalibrated scores."""
        other = copy.copy(self)
        other.header = replace(self.header, calibration={})
        return other

    def to_raw_scores(self, scores: Mapping[str, float]) -> list[float]:
        """Convert calibrated scores by class to a list of raw network scores in the order of `classes`."""
        return [to_raw_score(name, scores[name], self.header.calibration) for name in self.classes]

    def move(self, device: str, cpu_fallback: bool = True) -> None:
        """Move the network to a device, or to the CPU if the device is out of memory.

        Raises:
            InputError: the device is out of memory and `cpu_fallback` is False.
        """
        self.placement.device = device
        try:
            self.network.to(device)
        except RuntimeError as error:
            self._fall_back(error, cpu_fallback)

    def run(self, compute: Callable[[], Result], cpu_fallback: bool = True) -> Result:
        """Return compute(); run it again on the CPU if the device is out of memory.

        Raises:
            InputError: the device is out of memory and `cpu_fallback` is False.
        """
        try:
            return compute()
        except RuntimeError as error:
            self._fall_back(error, cpu_fallback)
            return compute()

    def _fall_back(self, error: RuntimeError, cpu_fallback: bool) -> None:
        """Move the network to the CPU if the device is out of memory; re-raise any other error."""
        if not is_out_of_memory(error):
            raise error
        if self.device == CPU or not cpu_fallback:
            raise InputError(f"{self.device} is out of memory; use the CPU or a smaller network") from error
        self.placement.fallback = (
            f"{self.device} is out of memory, so the network runs on the CPU; close other programs and restart"
        )
        self.move(CPU)

    def get_time(self) -> float:
        """Wait for all queued work on the device and return the time in seconds."""
        if self.device.startswith("cuda"):
            import torch

            torch.cuda.synchronize(self.device)
        return perf_counter()

    def find_best_scores(self, scores: Iterable[float]) -> tuple[dict[str, float], str | None]:
        """Return the highest score of each class by name, and a problem if one of them is NaN.

        Used for clouds without detections.
        """
        best_scores = dict(zip(self.classes, scores))
        has_nan = any(map(math.isnan, best_scores.values()))
        return best_scores, "the network's scores are NaN; check the weights and the intensity" if has_nan else None

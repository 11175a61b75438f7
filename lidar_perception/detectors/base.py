"""What detectors with a network share: the device, what takes over, and what is said of a frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from time import perf_counter
from typing import Any, TypeVar

import torch

from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.devices import CPU
from lidar_perception.detectors.params import NetworkParams
from lidar_perception.types import InputError

Result = TypeVar("Result")


class NetworkDetector:
    """Base of the detectors. params, their parameters, may be replaced at any time. After each call
    ms holds the time of each step (on CUDA after synchronisation), problem why nothing, or little,
    can be found in this frame, or None, and best, where no score reached its threshold, the highest
    score of each class. fallback: why the CPU took over, or None.
    """

    def __init__(self, header: Header, device: torch.device, params: Any, steps: tuple[str, ...]):
        self.header, self.config, self.params, self.device = header, header.config, params, device
        self.ms: dict[str, float] = dict.fromkeys(steps, 0.0)
        self.problem: str | None = None
        self.best: dict[str, float] = {}
        self.fallback: str | None = None

    @property
    def settings(self) -> NetworkParams:
        """The network's own group of params."""
        raise NotImplementedError

    def place(self, device: torch.device) -> None:
        """Bring the network, and what it needs, to a device."""
        raise NotImplementedError

    def move(self, device: torch.device) -> None:
        """Run on another device from now on, or on the CPU if there is no memory left on it."""
        self.device = device
        try:
            self.place(device)
        except torch.cuda.OutOfMemoryError as error:
            self._fall_back(error)

    def guarded(self, work: Callable[[], Result]) -> Result:
        """What work() gives; once more on the CPU if the device runs out of memory. InputError
        where the CPU may not take over."""
        try:
            return work()
        except torch.cuda.OutOfMemoryError as error:
            self._fall_back(error)
            return work()

    def _fall_back(self, error: Exception) -> None:
        if self.device == CPU or not self.settings.cpu_fallback:
            raise InputError(f"no memory left on {self.device}; use the CPU or a smaller network"
                             ) from error
        self.fallback = self.problem = (f"{self.device} has no memory left, so the network runs on "
                                        "the CPU; close other programs and start again")
        self.move(CPU)

    def now(self) -> float:
        """Seconds of a clock, after what the device has been asked to do is done."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return perf_counter()

    def nothing_passed(self, highest: Iterable[float]) -> None:
        """Keep the highest score of each class, as none reached its threshold."""
        self.best = dict(zip(self.config.classes, highest))
        if any(map(math.isnan, self.best.values())):
            self.problem = ("the network's scores are not numbers (NaN); the weights or the "
                            "intensity are broken")

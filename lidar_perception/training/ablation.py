"""Networks that are compared: as many steps on the same scenes for all, however fast each is."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import tee
from typing import Any

import torch

from lidar_perception.detectors.devices import chosen_device
from lidar_perception.param_fields import with_values
from lidar_perception.simulation.sensor import sensor_named
from lidar_perception.training.asked import Asked
from lidar_perception.training.data import Item
from lidar_perception.training.out import SCANS, alone
from lidar_perception.training.plan import TooShort
from lidar_perception.training.ranks import joined, wait
from lidar_perception.training.start import (
    BUDGET,
    Network,
    begins_with,
    check,
    planned,
    settings_of,
)
from lidar_perception.types import InputError


@dataclass(frozen=True)
class Compared:
    """See start.Planning: of several networks the slowest counts."""

    networks: tuple[Network, ...]

    @property
    def name(self) -> str:
        """For people."""
        return f"each of {len(self.networks)} networks"

    @property
    def cutting(self) -> str:
        """The same for all."""
        return self.networks[0].cutting

    def most_cuts(self, params: Any) -> int:
        """Of any."""
        return max(network.most_cuts(params) for network in self.networks)

    def part(self, params: Any) -> dict[str, Any]:
        """All of them see the whole range."""
        return {}

    def measured(self, params: Any, scenes: Iterable[Item], held_out: Sequence[Any],
                 device: torch.device) -> tuple[float, float, float, float]:
        """The longest times, with the same scenes."""
        each = zip(self.networks, tee(scenes, len(self.networks)))
        cut, step, whole, frame = (max(times) for times in zip(*(
            network.measured(params, own, held_out, device) for network, own in each)))
        return cut, step, whole, frame


@contextmanager
def compared(networks: Sequence[Network], asked: Asked, params: Any) -> Iterator[tuple[Asked, Any]]:
    """What to ask for each of the networks, in a folder of its own in asked.out: its share of the
    budget, and params with the plan for all, which is kept as that of a run. Scans are shared, too.
    InputError as of start.
    """
    init = begins_with(networks[0], asked, params)
    check(asked, init)
    if not params.data.cache:
        params = with_values(params, {"data.cache": str(asked.out / SCANS)})
    hours = asked.budget or (None if params.steps or params.epochs else BUDGET)
    share = replace(asked, budget=hours and hours / len(networks))
    sensor = sensor_named(params.sensor, params.mount_height)
    settings = settings_of(asked, params, sensor, init, compared=len(networks))
    with joined(chosen_device(asked.device)) as device, alone(asked.out):
        wait()  # until all have looked at what the first is going to write
        try:
            params = planned(Compared(tuple(networks)), share, params, settings, sensor, device)
        except TooShort as error:
            raise InputError(f"a budget of {hours:g} h is too short for {len(networks)} networks "
                             f"on this machine: give --budget {error.enough * len(networks):.2g} "
                             "or more, or fewer --data-scans and --data-val-scans") from None
        yield share, params

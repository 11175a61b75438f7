"""Interface of a trainer: the parts of a training run that depend on the network."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import torch
from torch import nn

from lidar_perception.training.data import Item, SceneReader, Stream
from lidar_perception.training.plan import Speed
from lidar_perception.training.run import Validation


class Cuts(NamedTuple):
    """Sources of objects or clusters cut from scenes, and the numbers of the scenes to cut in each source."""

    sources: list[Any]
    numbers: list[Sequence[int]]


class Trainer(Protocol):
    """The parts of a training run that depend on the network; `params` are the parameters of the training."""

    @property
    def config(self) -> Any:
        """Configuration of the network."""

    @property
    def name(self) -> str:
        """Name of the network in messages."""

    @property
    def cutting_title(self) -> str:
        """Title of the progress bar while objects or clusters are cut."""

    def find_max_cut_scenes(self, params: Any) -> int:
        """Return the maximum number of scenes from which objects or clusters are cut."""

    def find_reduced_range(self, params: Any) -> dict[str, Any]:
        """Return parameters that limit training to a part of the range, which is faster; {} if that is impossible."""

    def measure_speed(
        self, params: Any, scenes: Iterable[Item], val_sources: Sequence[Any], device: torch.device
    ) -> Speed:
        """Measure the speed on the first usable scenes, without simulation. Raise InputError if there are none."""

    def find_packaged_weights(self, params: Any) -> Path:
        """Return the path of the packaged weights. Raise InputError if there are none."""

    def make_cuts(self, params: Any, sources: Sequence[Any], val_sources: Sequence[Any], cache: Path) -> Cuts:
        """Return the sources of cut objects or clusters. They cut nothing until a scene is loaded."""

    def collect_cuts(self, params: Any, cuts: Cuts, out: Path) -> None:
        """Write the cut objects or clusters to the folder out for training."""

    def make_streams(
        self, params: Any, sources: Sequence[Any], val_sources: Sequence[Any], cuts: Cuts, out: Path
    ) -> tuple[Stream, SceneReader]:
        """Return the stream of training samples and the validation scenes."""

    def make_network(self) -> nn.Module:
        """Make the network with random weights."""

    def make_loss(self, params: Any, device: torch.device) -> Callable:
        """Return the loss function, see Task."""

    def make_validate(
        self, params: Any, val_scenes: SceneReader, device: torch.device, jobs: int
    ) -> Callable[[Any], Validation]:
        """Return the validation function, see Task. It reads scenes in `jobs` processes."""

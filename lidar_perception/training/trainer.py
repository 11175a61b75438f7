"""The interface of a network to training: everything about a run that depends on the network."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import torch

from lidar_perception.training.data import Batches, Item, SceneReader, Stream
from lidar_perception.training.run import Task


class Cuts(NamedTuple):
    """Sources of objects or clusters cut from scenes, and the scene numbers to cut of each."""

    sources: list[Any]
    numbers: list[Sequence[int]]


class StepSpeed(NamedTuple):
    """Measured durations in seconds, see plan.Speed."""

    cut: float
    step: float
    whole: float
    frame: float


class Trainer(Protocol):
    """Training of one network. Parameters may have a plan applied or not."""

    @property
    def name(self) -> str:
        """Name of the network in messages."""

    @property
    def cutting(self) -> str:
        """Title of the progress bar while scenes are cut."""

    def max_cuts(self, params: Any) -> int:
        """Return the largest number of scenes to cut."""

    def reduced_range(self, params: Any) -> dict[str, Any]:
        """Return the parameters that restrict training to a part of the range, which is faster.

        Empty if there is no such choice.
        """

    def measure_speed(
        self, params: Any, scenes: Iterable[Item], held_out: Sequence[Any], device: torch.device
    ) -> StepSpeed:
        """Measure durations on the first usable scenes. Raise InputError if none can be used."""

    def packaged_weights(self, params: Any) -> Path:
        """Return the weights that ship with the package. Raise InputError if there are none."""

    def make_cuts(self, params: Any, sources: Sequence[Any], held_out: Sequence[Any], cache: Path) -> Cuts:
        """Return the objects or clusters to cut from the scenes; nothing is cut yet."""

    def collect_cuts(self, params: Any, cuts: Cuts, out: Path) -> None:
        """Write the cut objects or clusters into out, in the form that training reads."""

    def make_streams(
        self, params: Any, sources: Sequence[Any], held_out: Sequence[Any], cuts: Cuts, out: Path
    ) -> tuple[Stream, SceneReader]:
        """Return the samples to train on and the scenes to validate on."""

    def make_task(
        self,
        params: Any,
        batches: Batches,
        held_out: SceneReader,
        out: Path,
        device: torch.device,
        about: dict[str, Any],
        commit: str,
        init: Path | None,
    ) -> Task:
        """Return the task of the training loop.

        Args:
            params: Parameters of the training, with a plan.
            batches: Samples to train on.
            held_out: Scenes to validate on.
            out: Folder for best.safetensors and last.safetensors.
            device: Device of the network.
            about: Description of the data for the header; a resumed run must have the same.
            commit: Version of the code for the header.
            init: Checkpoint to start from, see checkpoint.copy_matching_weights.
        """

"""Interface of a trainer: the parts of a training run that depend on the network."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import torch

from lidar_perception.training.data import Batches, Item, SceneReader, Stream
from lidar_perception.training.run import Task


class Cuts(NamedTuple):
    """Sources of objects or clusters cut from scenes, and the numbers of the scenes to cut in each source."""

    sources: list[Any]
    numbers: list[Sequence[int]]


class StepSpeed(NamedTuple):
    """The durations of plan.Speed that depend on the network, in seconds."""

    cut: float
    step: float
    whole: float
    frame: float


class Trainer(Protocol):
    """The parts of a training run that depend on the network.

    The argument `params` of all methods has the parameters of the training.
    """

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
    ) -> StepSpeed:
        """Measure durations on the first usable scenes. Raise InputError if there are none."""

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

    def make_task(
        self,
        params: Any,
        batches: Batches,
        val_scenes: SceneReader,
        out: Path,
        device: torch.device,
        data_info: dict[str, Any],
        commit: str,
        init: Path | None,
    ) -> Task:
        """Make the task of the training loop.

        Args:
            params: Parameters of the training, with the numbers of the plan.
            batches: Batches of training samples.
            val_scenes: Validation scenes.
            out: Folder for best.safetensors and last.safetensors.
            device: Device of the network.
            data_info: Description of the data for the header. It must be the same in a resumed run.
            commit: Version of the code for the header.
            init: Checkpoint with initial weights, see checkpoint.copy_matching_weights; None for random ones.
        """

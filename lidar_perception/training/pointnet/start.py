"""How the training of a cluster network begins: its speed, and the clusters of all scenes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidar_perception.detectors.checkpoint import POINTPILLARS, network_of
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.detectors.pointnet.network import make_pointnet
from lidar_perception.detectors.pointnet.params import PointNetParams
from lidar_perception.detectors.pointnet.weights_file import weights_file
from lidar_perception.detectors.pointpillars.params import PointPillarsParams
from lidar_perception.detectors.pointpillars.weights_file import weights_file as pointpillars_file
from lidar_perception.detectors.weights_file import existing
from lidar_perception.training.augment import TrainingScene
from lidar_perception.training.data import Batches, Item, ReadScenes, Stream
from lidar_perception.training.measuring import first_read, seconds_of_step, timed, usable
from lidar_perception.training.params import PointNetTraining
from lidar_perception.training.pointnet.cut_scenes import CutScene, CutScenes, cut
from lidar_perception.training.pointnet.task import (
    ClusterPreparation,
    clusters_to_validate,
    make_loss,
    make_task,
    validated,
)
from lidar_perception.training.run import Task
from lidar_perception.training.start import PACKAGE
from lidar_perception.types import InputError

MANY = 8  # frames that are validated to know the time of one, as the calibration takes its own


def proposer_of(params: PointNetTraining) -> Path | None:
    """The file that params.proposer names. InputError if it is not there, or no PointPillars."""
    if params.proposer in ("", str(PACKAGE)):
        return pointpillars_file(PointPillarsParams()) if params.proposer else None
    path = existing(params.proposer, "proposer")
    if network_of(path) != POINTPILLARS:
        raise InputError(f"{path} is no PointPillars, whose weights `proposer` names")
    return path


@dataclass(frozen=True)
class PointNetStart:
    """See start.Network. config: of the network that is trained."""

    config: PointNetConfig
    cutting: str = "cutting clusters"

    @property
    def name(self) -> str:
        """What is trained, for people."""
        return f"PointNet {self.config.title}".strip()

    def own_weights(self, params: PointNetTraining) -> Path:
        """Of the improved network; of others as far as they fit."""
        return weights_file(PointNetParams())

    def most_cuts(self, params: PointNetTraining) -> int:
        """All scenes are cut."""
        return 10**9

    def part(self, params: PointNetTraining) -> dict[str, Any]:
        """Clusters are looked at wherever they are."""
        return {}

    def measured(self, params: PointNetTraining, scenes: Iterable[Item], held_out: Sequence[Any],
                 device: torch.device) -> tuple[float, float, float, float]:
        """With clusters of these scenes."""
        prepare = ClusterPreparation(self.config, params.augment)
        rng, proposer = partial(np.random.default_rng, 0), proposer_of(params)

        def cut_out(scene: TrainingScene) -> CutScene:
            return cut(scene, self.config, params.data.min_points, proposer)

        chosen = usable(scenes, lambda scene: prepare(cut_out(scene), rng()))  # compiles, too
        cutting, parts = timed(lambda: [cut_out(scene) for scene in chosen])
        network = make_pointnet(self.config).to(device)
        step = seconds_of_step(network, make_loss(self.config, device), lambda: [
            prepare(part, rng()) for part in parts], params, device)
        frame = first_read(ReadScenes(tuple(
            CutScenes(source, self.config, params.data.min_points) for source in held_out),
            clusters_to_validate), lambda frame: len(frame.clusters) > 0)
        network.eval()
        with torch.no_grad():
            validated(network, [frame])
            validating = timed(lambda: validated(network, [frame] * MANY))[0] / MANY
        return cutting / len(chosen), step, step, validating

    def cut(self, params: PointNetTraining, sources: Sequence[Any], held_out: Sequence[Any],
            cache: Path) -> tuple[list[Any], list[Sequence[int]]]:
        """The clusters of all scenes."""
        made = partial(CutScenes, config=self.config, min_points=params.data.min_points,
                       cache=cache / "clusters", proposer=proposer_of(params))
        cuts = [*(made(source, sparse=params.augment.sparse) for source in sources),
                *map(made, held_out)]
        return cuts, [range(len(source)) for source in cuts]

    def gather(self, params: PointNetTraining, cut: tuple[list[Any], list], out: Path) -> None:
        """Nothing."""

    def scenes(self, params: PointNetTraining, sources: Sequence[Any], held_out: Sequence[Any],
               cut: tuple[list[Any], list], out: Path) -> tuple[Stream, ReadScenes]:
        """Of the clusters."""
        learned, judged = cut[0][:len(sources)], cut[0][len(sources):]
        prepare = ClusterPreparation(self.config, params.augment, bool(params.proposer))
        return (Stream(tuple(learned), prepare, params.seed),
                ReadScenes(tuple(judged), clusters_to_validate))

    def task(self, params: PointNetTraining, batches: Batches, held_out: ReadScenes, out: Path,
             device: torch.device, about: dict[str, Any], commit: str, init: Path | None) -> Task:
        """See make_task."""
        return make_task(self.config, params, batches, held_out, out, device, about, commit, init)

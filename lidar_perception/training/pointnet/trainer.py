"""Trainer of PointNet."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidar_perception.detectors.checkpoint import POINTPILLARS, read_header
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.detectors.pointnet.network import PointNet
from lidar_perception.detectors.pointnet.params import PointNetParams
from lidar_perception.detectors.weights_file import find_pointnet_weights, find_proposer_weights, require_weights
from lidar_perception.training.augment import TrainingScene
from lidar_perception.training.data import Item, SceneReader, Stream, load_items
from lidar_perception.training.params import PointNetTraining
from lidar_perception.training.plan import Speed
from lidar_perception.training.pointnet.cut_scenes import CutScene, CutScenes, cut_clusters
from lidar_perception.training.pointnet.task import (
    ClusterPreparation,
    ValidationClusters,
    load_validation_clusters,
    make_loss,
    validate_network,
)
from lidar_perception.training.record import report_skipped
from lidar_perception.training.request import PACKAGE
from lidar_perception.training.run import Validation
from lidar_perception.training.timing import find_readable_frame, measure_duration, measure_step, select_usable_scenes
from lidar_perception.training.trainer import Cuts
from lidar_perception.types import InputError

TIMED_FRAMES = 8  # frames to time validation with; several, so that the calibration matters little


def find_proposer(params: PointNetTraining) -> Path | None:
    """Return the path in params.proposer, None if empty. Raise InputError if it is not a PointPillars checkpoint."""
    if params.proposer in ("", str(PACKAGE)):
        return find_proposer_weights() if params.proposer else None
    path = require_weights(params.proposer, "proposer")
    if read_header(path).network != POINTPILLARS:
        raise InputError(f"{path} is not a PointPillars checkpoint; give one with --proposer")
    return path


@dataclass(frozen=True)
class PointNetTrainer:
    """Trainer of PointNet in one configuration; see Trainer for the methods."""

    config: PointNetConfig
    cutting_title = "cutting clusters"

    @property
    def name(self) -> str:
        return f"PointNet {self.config.title}".strip()

    def find_packaged_weights(self, params: PointNetTraining) -> Path:
        """Return the weights of the improved network, which partly fit the other configurations."""
        return find_pointnet_weights(PointNetParams())

    def find_max_cut_scenes(self, params: PointNetTraining) -> int:
        """Return a number larger than any data set, because clusters are cut from all scenes."""
        return 10**9

    def find_reduced_range(self, params: PointNetTraining) -> dict[str, Any]:
        """Return {}, because clusters at all ranges are used."""
        return {}

    def measure_speed(
        self, params: PointNetTraining, scenes: Iterable[Item], val_sources: Sequence[Any], device: torch.device
    ) -> Speed:
        """Measure the speed on the clusters of the first usable scenes."""
        prepare = ClusterPreparation(self.config, params.augment)
        make_rng, proposer = partial(np.random.default_rng, 0), find_proposer(params)

        def cut_scene(scene: TrainingScene) -> CutScene:
            return cut_clusters(scene, self.config, params.data.min_points, proposer)

        def prepare_scene(scene: TrainingScene) -> Any:
            return prepare(cut_scene(scene), make_rng())

        usable_scenes = select_usable_scenes(scenes, prepare_scene)  # also compiles kernels
        cutting, cut_scenes = measure_duration(lambda: [cut_scene(scene) for scene in usable_scenes])
        network = self.make_network().to(device)
        step = measure_step(
            network,
            self.make_loss(params, device),
            lambda: [prepare(scene, make_rng()) for scene in cut_scenes],
            params,
            device,
        )
        frame = find_readable_frame(
            SceneReader(
                tuple(CutScenes(source, self.config, params.data.min_points) for source in val_sources),
                load_validation_clusters,
            ),
            lambda frame: len(frame.clusters) > 0,
        )
        network.eval()
        with torch.no_grad():
            validate_network(network, [frame])
            validation, _ = measure_duration(lambda: validate_network(network, [frame] * TIMED_FRAMES))
        return Speed(cutting / len(usable_scenes), step, step, validation / TIMED_FRAMES)

    def make_cuts(
        self, params: PointNetTraining, sources: Sequence[Any], val_sources: Sequence[Any], cache: Path
    ) -> Cuts:
        """Return the sources of clusters, which are cut from all scenes."""
        cut = partial(
            CutScenes,
            config=self.config,
            min_points=params.data.min_points,
            cache=cache / "clusters",
            proposer=find_proposer(params),
        )
        cuts = [*(cut(source, sparse=params.augment.sparse) for source in sources), *map(cut, val_sources)]
        return Cuts(cuts, [range(len(source)) for source in cuts])

    def collect_cuts(self, params: PointNetTraining, cuts: Cuts, out: Path) -> None:
        """Do nothing, because training reads the clusters from the cache."""

    def make_streams(
        self, params: PointNetTraining, sources: Sequence[Any], val_sources: Sequence[Any], cuts: Cuts, out: Path
    ) -> tuple[Stream, SceneReader]:
        training, validation = cuts.sources[: len(sources)], cuts.sources[len(sources) :]
        prepare = ClusterPreparation(self.config, params.augment, bool(params.proposer))
        return (Stream(tuple(training), prepare, params.seed), SceneReader(tuple(validation), load_validation_clusters))

    def make_network(self) -> PointNet:
        return PointNet(self.config)

    def make_loss(self, params: PointNetTraining, device: torch.device) -> Callable:
        return make_loss(self.config, device)

    def make_validate(
        self, params: PointNetTraining, val_scenes: SceneReader, device: torch.device, jobs: int
    ) -> Callable[[Any], Validation]:
        scenes: list[ValidationClusters] = []

        def validate(module: PointNet) -> Validation:
            if not scenes:
                items = [item for (item,) in load_items(val_scenes, ([n] for n in range(len(val_scenes))), jobs)]
                scenes.extend(item.sample for item in items if item.sample is not None)
                report_skipped([reason for item in items for reason in item.skipped], len(scenes), set())
            return validate_network(module, scenes)

        return validate

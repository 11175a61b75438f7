"""Trainer of PointPillars."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.pointpillars.config import NetworkConfig
from lidar_perception.detectors.pointpillars.detector import PointPillarsDetector
from lidar_perception.detectors.pointpillars.network import PointPillars, make_network, to_channels_last
from lidar_perception.detectors.pointpillars.params import PointPillarsParams
from lidar_perception.detectors.pointpillars.proposer import PointPillarsProposer
from lidar_perception.detectors.pointpillars.torch_network import TorchNetwork
from lidar_perception.detectors.weights_file import find_pointpillars_weights
from lidar_perception.training.cut_objects import CutObjects, cut_objects, join_databases
from lidar_perception.training.data import Item, SceneReader, Stream
from lidar_perception.training.params import PointPillarsTraining
from lidar_perception.training.plan import Speed
from lidar_perception.training.pointpillars.task import (
    VALIDATION_PARAMS,
    ScenePreparation,
    detect_in_frame,
    load_validation_frame,
    make_loss,
    reduce_range,
    validate_detector,
)
from lidar_perception.training.record import report_skipped, summarize_report
from lidar_perception.training.run import Validation
from lidar_perception.training.timing import find_readable_frame, measure_duration, measure_step, select_usable_scenes
from lidar_perception.training.trainer import Cuts
from lidar_perception.types import InputError

OBJECTS = "objects.npz"
# Ranges ahead and aside in metres that contain most objects.
REDUCED_RANGES = {"ahead": (46.08, 23.04), "around": (30.72, 30.72)}


@dataclass(frozen=True)
class PointPillarsTrainer:
    """Trainer of PointPillars in one configuration; see Trainer for the methods."""

    config: NetworkConfig
    cutting_title = "cutting objects"

    @property
    def name(self) -> str:
        return f"PointPillars {self.config.title}"

    def find_packaged_weights(self, params: PointPillarsTraining) -> Path:
        """Return the weights of the same version and size."""
        return find_pointpillars_weights(PointPillarsParams(version=params.version, size=params.size))

    def find_max_cut_scenes(self, params: PointPillarsTraining) -> int:
        """Return the number of scenes from which objects are cut; 0 if no objects are pasted."""
        augment = params.augment
        has_objects = augment.cars or augment.pedestrians or augment.cyclists or augment.things
        return augment.database_scans if augment.crowded and has_objects else 0

    def find_reduced_range(self, params: PointPillarsTraining) -> dict[str, Any]:
        """Return a range that contains most objects; {} if the user gave a range."""
        ahead, aside = REDUCED_RANGES[params.range]
        return {} if params.ahead or params.aside else {"ahead": ahead, "aside": aside}

    def measure_speed(
        self, params: PointPillarsTraining, scenes: Iterable[Item], val_sources: Sequence[Any], device: torch.device
    ) -> Speed:
        """Measure the speed on the first usable scenes, with objects that are cut from them."""
        config = reduce_range(
            self.config, **(self.find_reduced_range(params) or {"ahead": params.ahead, "aside": params.aside})
        )
        prepare = ScenePreparation(config, params.augment, params.data.min_points)
        usable_scenes = select_usable_scenes(scenes, lambda scene: prepare(scene, np.random.default_rng(0)))
        cut = partial(cut_objects, classes=config.classes, min_points=params.data.min_points)
        cut(usable_scenes[0])  # triggers compilation
        cutting, databases = measure_duration(lambda: [cut(scene) for scene in usable_scenes])
        network = self.make_network().to(device)
        with tempfile.TemporaryDirectory() as folder:
            join_databases(databases).save(Path(folder) / OBJECTS)
            if self.find_max_cut_scenes(params):
                prepare = replace(prepare, database=Path(folder) / OBJECTS)
            step = measure_step(
                network,
                make_loss(config, device),
                lambda: [prepare(scene, np.random.default_rng(0)) for scene in usable_scenes],
                params,
                device,
            )
        detector = self._make_detector(network, device)
        frame = find_readable_frame(
            self._make_reader(val_sources), lambda frame: detect_in_frame(frame, detector).problem is None
        )
        full_range_step = step * np.prod(self.config.grid) / np.prod(config.grid)
        validation, _ = measure_duration(lambda: detect_in_frame(frame, detector))
        return Speed(cutting / len(usable_scenes), step, float(full_range_step), validation)

    def make_cuts(
        self, params: PointPillarsTraining, sources: Sequence[Any], val_sources: Sequence[Any], cache: Path
    ) -> Cuts:
        """Return the sources of objects, which are cut from randomly drawn scenes."""
        ends = np.cumsum([0, *map(len, sources)])
        indices = np.random.default_rng(params.seed).permutation(ends[-1])[: self.find_max_cut_scenes(params)]
        min_points, folder = params.data.min_points, cache / "objects"
        cuts = [CutObjects(source, self.config.classes, min_points, folder) for source in sources]
        numbers = [
            np.sort(indices[(indices >= first) & (indices < end)] - first).tolist() for first, end in pairwise(ends)
        ]
        return Cuts(cuts, numbers)

    def collect_cuts(self, params: PointPillarsTraining, cuts: Cuts, out: Path) -> None:
        """Write all cut objects to out / OBJECTS."""
        if not self.find_max_cut_scenes(params) or (out / OBJECTS).is_file():
            return
        databases = []
        for source, numbers in zip(*cuts):
            for i in numbers:
                try:
                    databases.append(source.load_scene(i))
                except InputError:  # training reports it later
                    continue
        join_databases(databases).save(out / OBJECTS)

    def make_streams(
        self, params: PointPillarsTraining, sources: Sequence[Any], val_sources: Sequence[Any], cuts: Cuts, out: Path
    ) -> tuple[Stream, SceneReader]:
        prepare = ScenePreparation(
            reduce_range(self.config, params.ahead, params.aside),
            params.augment,
            params.data.min_points,
            out / OBJECTS if self.find_max_cut_scenes(params) else None,
        )
        return Stream(tuple(sources), prepare, params.seed), self._make_reader(val_sources)

    def make_network(self) -> PointPillars:
        return to_channels_last(make_network(self.config))

    def make_loss(self, params: PointPillarsTraining, device: torch.device) -> Callable:
        return make_loss(reduce_range(self.config, params.ahead, params.aside), device)

    def make_validate(
        self, params: PointPillarsTraining, val_scenes: SceneReader, device: torch.device, jobs: int
    ) -> Callable[[Any], Validation]:
        reported_reasons: set[str] = set()

        def validate(module: PointPillars) -> Validation:
            report = validate_detector(self._make_detector(module, device), val_scenes, jobs)
            report_skipped(report.skipped, len(report.frames), reported_reasons)
            return summarize_report(report, params.score, self.config.classes)

        return validate

    def _make_detector(self, network: PointPillars, device: torch.device) -> PointPillarsDetector:
        proposer = PointPillarsProposer(TorchNetwork(network, str(device)), Header(self.config), str(device))
        return PointPillarsDetector(proposer, VALIDATION_PARAMS)

    def _make_reader(self, val_sources: Sequence[Any]) -> SceneReader:
        return SceneReader(tuple(val_sources), partial(load_validation_frame, self.config))

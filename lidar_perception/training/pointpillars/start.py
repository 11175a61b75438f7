"""How the training of a PointPillars begins: its speed, and the objects that are pasted."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.pointpillars.config import NetworkConfig
from lidar_perception.detectors.pointpillars.detector import PointPillarsDetector, TorchNetwork
from lidar_perception.detectors.pointpillars.network import channels_last, make_network
from lidar_perception.detectors.pointpillars.params import PointPillarsParams
from lidar_perception.detectors.pointpillars.weights_file import weights_file
from lidar_perception.training.cut_objects import CutObjects, cut, joined
from lidar_perception.training.data import Batches, Item, ReadScenes, Stream
from lidar_perception.training.database import Database
from lidar_perception.training.measuring import first_read, seconds_of_step, timed, usable
from lidar_perception.training.params import PointPillarsTraining
from lidar_perception.training.pointpillars.task import (
    VALIDATED,
    Preparation,
    found_in,
    frame_to_validate,
    make_loss,
    make_task,
    narrowed,
)
from lidar_perception.training.run import Task
from lidar_perception.types import InputError

OBJECTS = "objects.npz"
PARTS = {"ahead": (46.08, 23.04), "around": (30.72, 30.72)}  # m ahead and aside, where most is


@dataclass(frozen=True)
class PointPillarsStart:
    """See start.Network. config: of the network that is trained."""

    config: NetworkConfig
    cutting: str = "cutting objects"

    @property
    def name(self) -> str:
        """What is trained, for people."""
        return f"PointPillars {self.config.title}"

    def own_weights(self, params: PointPillarsTraining) -> Path:
        """Of the same version and size."""
        return weights_file(PointPillarsParams(version=params.version, size=params.size))

    def most_cuts(self, params: PointPillarsTraining) -> int:
        """0 where no objects are pasted."""
        wanted = params.augment
        pasted = wanted.crowded and (wanted.cars or wanted.pedestrians or wanted.cyclists
                                     or wanted.things)
        return wanted.database_scans if pasted else 0

    def part(self, params: PointPillarsTraining) -> dict[str, Any]:
        """None if a part of the range, or all of it, is asked for."""
        ahead, aside = PARTS[params.range]
        return {} if params.ahead or params.aside else {"ahead": ahead, "aside": aside}

    def measured(self, params: PointPillarsTraining, scenes: Iterable[Item],
                 held_out: Sequence[Any], device: torch.device
                 ) -> tuple[float, float, float, float]:
        """With objects of the scenes themselves."""
        def objects() -> list[Database]:
            return [cut(scene, self.config.classes, params.data.min_points) for scene in chosen]

        seen = narrowed(self.config, **(self.part(params) or {"ahead": params.ahead,
                                                              "aside": params.aside}))
        bare = Preparation(seen, params.augment, params.data.min_points)
        chosen = usable(scenes, lambda scene: bare(scene, np.random.default_rng(0)))
        cut(chosen[0], self.config.classes, params.data.min_points)  # compiles
        cutting, parts = timed(objects)
        network = make_network(self.config).to(device)
        channels_last(network)
        with tempfile.TemporaryDirectory() as folder:
            joined(parts).save(Path(folder) / OBJECTS)
            prepare = replace(bare, database=Path(folder) / OBJECTS if self.most_cuts(params)
                              else None)
            step = seconds_of_step(network, make_loss(seen, device), lambda: [
                prepare(scene, np.random.default_rng(0)) for scene in chosen], params, device)
        detector = PointPillarsDetector(TorchNetwork(network, device), Header(self.config), device,
                                        VALIDATED)
        frame = first_read(self._to_validate(held_out),
                           lambda frame: found_in(frame, detector).problem is None)
        whole = step * np.prod(self.config.grid) / np.prod(seen.grid)
        validating = timed(lambda: found_in(frame, detector))[0]
        return cutting / len(chosen), step, float(whole), validating

    def cut(self, params: PointPillarsTraining, sources: Sequence[Any], held_out: Sequence[Any],
            cache: Path) -> tuple[list[Any], list[Sequence[int]]]:
        """The objects of some scenes, drawn by the seed."""
        ends = np.cumsum([0, *map(len, sources)])
        chosen = np.random.default_rng(params.seed).permutation(ends[-1])[:self.most_cuts(params)]
        cuts = [CutObjects(source, self.config.classes, params.data.min_points, cache / "objects")
                for source in sources]
        return cuts, [np.sort(chosen[(chosen >= first) & (chosen < end)] - first).tolist()
                      for first, end in pairwise(ends)]

    def gather(self, params: PointPillarsTraining, cut: tuple[list[Any], list],
               out: Path) -> None:
        """OBJECTS: all objects that were cut."""
        if not self.most_cuts(params) or (out / OBJECTS).is_file():
            return
        parts = []
        for source, numbers in zip(*cut):
            for i in numbers:
                try:
                    parts.append(source.scene(i))
                except InputError:  # it is said when it is to be learned from
                    continue
        joined(parts).save(out / OBJECTS)

    def scenes(self, params: PointPillarsTraining, sources: Sequence[Any], held_out: Sequence[Any],
               cut: tuple[list[Any], list], out: Path) -> tuple[Stream, ReadScenes]:
        """Of the scenes themselves."""
        prepare = Preparation(narrowed(self.config, params.ahead, params.aside), params.augment,
                              params.data.min_points,
                              out / OBJECTS if self.most_cuts(params) else None)
        return Stream(tuple(sources), prepare, params.seed), self._to_validate(held_out)

    def _to_validate(self, held_out: Sequence[Any]) -> ReadScenes:
        return ReadScenes(tuple(held_out), partial(frame_to_validate, self.config))

    def task(self, params: PointPillarsTraining, batches: Batches, held_out: ReadScenes, out: Path,
             device: torch.device, about: dict[str, Any], commit: str, init: Path | None) -> Task:
        """See make_task."""
        return make_task(self.config, params, batches, held_out, out, device, about, commit, init)

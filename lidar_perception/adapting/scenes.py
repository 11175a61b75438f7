"""What is learned from: real clouds with the labels that were concluded, as a source of scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha1
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.adapting.judging import IGNORED, KEPT
from lidar_perception.adapting.labels import ConcludedLabels
from lidar_perception.classes import DONT_CARE
from lidar_perception.data.frame import Frame
from lidar_perception.data.open import open_recording
from lidar_perception.geometry import within
from lidar_perception.training.augment import TrainingScene
from lidar_perception.training.cache import write_arrays
from lidar_perception.types import InputError


def save_labels(path: Path, numbers: Sequence[int], labels: Sequence[ConcludedLabels]) -> None:
    """Write an .npz file of the labels of frames with these numbers in their recording: what is
    kept, and what is ignored as regions; what is rejected is background."""
    chosen = [np.flatnonzero(each.of(KEPT) | each.of(IGNORED)) for each in labels]
    kept = [each.of(KEPT)[k] for each, k in zip(labels, chosen)]
    class_ids = [np.where(own, each.class_ids[k], DONT_CARE)
                 for each, k, own in zip(labels, chosen, kept)]
    write_arrays(path, dict(
        numbers=np.array(numbers, np.int64),
        first=np.concatenate([[0], np.cumsum([len(k) for k in chosen])]).astype(np.int64),
        boxes=np.concatenate([each.boxes[k] for each, k in zip(labels, chosen)]).reshape(-1, 7),
        class_ids=np.concatenate(class_ids).astype(np.int32),
        kept=np.concatenate(kept).astype(bool)))


@dataclass(frozen=True)
class AdaptedScenes:
    """A source of scenes, see training/scenes.py, to train on only: frames of the recording at
    `path` with the labels in a file of save_labels. low, high (2,): only what lies between them is
    labelled, metres; height: of the sensor above the ground."""

    path: Path
    labels: Path
    low: tuple[float, float]
    high: tuple[float, float]
    height: float

    @cached_property
    def _arrays(self) -> dict[str, np.ndarray]:
        with np.load(self.labels) as arrays:
            return dict(arrays)

    @cached_property
    def _frames(self) -> Sequence[Frame]:
        return open_recording(self.path).frames

    @cached_property
    def _digest(self) -> str:
        return sha1(self.labels.read_bytes()).hexdigest()

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if not k.startswith("_")}

    def __len__(self) -> int:
        return len(self._arrays["numbers"])

    def key(self, i: int) -> str:
        """All that scene i depends on, as long as the recording stays as it is."""
        return repr((str(self.path), self._digest, i, self.low, self.high, self.height))

    def scene(self, i: int) -> TrainingScene:
        """InputError naming the file that cannot be used."""
        a = self._arrays
        scan = self._frames[int(a["numbers"][i])].load()
        points = scan.points()
        points = points[within(points, self.low, self.high)]
        own = slice(a["first"][i], a["first"][i + 1])
        everywhere = self.low[0] < 0
        return TrainingScene(points, a["boxes"][own], a["class_ids"][own], a["kept"][own],
                             everywhere, self.height)

    def frame(self, i: int) -> Frame:
        """InputError: nobody knows what is there."""
        raise InputError(f"{self.path} has no labels to validate on")

"""Disjoint scenes for the training, validation and test of an experiment.

The scenes are either simulated, or frames of a labelled recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.data.frame import BOXES, CAMERA, ComputedFrames, Frame, Recording
from lidar_perception.data.open import open_recording
from lidar_perception.runs.files import write_text
from lidar_perception.runs.resuming import hash_names
from lidar_perception.simulation.scene import Scenes
from lidar_perception.simulation.sensor import find_sensor
from lidar_perception.training.frames import LabelledFrames, open_labelled_frames
from lidar_perception.training.params import PAPER_VAL_FRACTION
from lidar_perception.training.scenes import SimulatedScenes
from lidar_perception.training.sources import SIM
from lidar_perception.types import InputError

FIRST_TEST_SCENE = 40_000_000  # seed of the first test scene, far from the seeds used for training
TEST_SCANS = 120
SPLIT_SEED = 0


@dataclass(frozen=True)
class ExperimentScenes:
    """The scenes of an experiment.

    Attributes:
        data: Path of a recording, or "sim".
        train, val, test: Names of the frames; empty for simulated scenes.
        height: Height of the sensor above the ground in metres; None uses that of the recording.
    """

    data: str
    train: tuple[str, ...] = ()
    val: tuple[str, ...] = ()
    test: tuple[str, ...] = ()
    height: float | None = None

    @staticmethod
    def split(data: str, test: Path | None = None) -> ExperimentScenes:
        """Split the frames of a recording.

        Args:
            data: Path of a recording, or "sim".
            test: File that lists the test frames. None draws as many frames as for validation,
                because KITTI's own test frames have no public labels.

        Raises:
            InputError: There are fewer than three labelled frames, a name is unknown, or `test` is
                given for simulated scenes.
        """
        if data == SIM:
            if test is not None:
                raise InputError("--split is for recordings; simulated scenes have no frame names to list")
            return ExperimentScenes(SIM)
        path = Path(data)
        frames = open_labelled_frames(path)
        if test is None:
            training_frames, test_frames = frames.split(PAPER_VAL_FRACTION, SPLIT_SEED)
        else:
            test_frames = open_labelled_frames(path, test)
            training_frames = frames.exclude([test_frames], "train on")
        train, val = training_frames.split(
            PAPER_VAL_FRACTION * len(frames.frames) / len(training_frames.frames), SPLIT_SEED
        )
        return ExperimentScenes(data, _list_names(train), _list_names(val), _list_names(test_frames), frames.height)

    @property
    def is_simulated(self) -> bool:
        return self.data == SIM

    def describe(self) -> dict[str, Any]:
        """Return a description that identifies these scenes, for the settings of a run."""
        return {
            "data": self.data if self.is_simulated else str(Path(self.data).resolve()),
            **{name: hash_names(getattr(self, name)) for name in ("train", "val", "test")},
        }

    def select_labelled(self, fraction: float) -> tuple[str, ...]:
        """Return a random fraction of the training frames. Smaller fractions are subsets of larger ones."""
        order = np.random.default_rng(SPLIT_SEED).permutation(len(self.train))
        count = max(1, round(fraction * len(self.train)))
        return tuple(self.train[i] for i in np.sort(order[:count]))

    def write_splits(self, folder: Path, fraction: float) -> tuple[Path, Path] | tuple[None, None]:
        """Write two files that list a fraction of the training frames, and the validation frames.

        Returns:
            The two files; None for simulated scenes.
        """
        if self.is_simulated:
            return None, None
        files = folder / f"train-{100 * fraction:g}.txt", folder / "val.txt"
        for file, names in zip(files, (self.select_labelled(fraction), self.val)):
            write_text(file, "\n".join(names))
        return files

    def open_test_recording(self, params: Any, cache: Path, count: int = TEST_SCANS) -> Recording:
        """Open the test frames.

        Args:
            params: Training parameters, which define the simulated sensor and scenes.
            cache: Folder in which simulated scans are cached.
            count: Number of simulated scans, each from a different scene.
        """
        if self.is_simulated:
            return open_simulated_scans(params, cache, count)
        return open_selected_frames(Path(self.data), self.test, self.height)


def _list_names(frames: LabelledFrames) -> tuple[str, ...]:
    return tuple(frame.name for frame in frames.frames)


def open_selected_frames(path: Path, names: Sequence[str], height: float | None) -> Recording:
    """Open a recording with only the frames that have these names."""
    recording = open_recording(path, sensor_height=height)
    frames = {frame.name: frame for frame in recording.frames[:]}
    return replace(
        recording,
        frames=[frames[name] for name in names],
        missing_scans=(),
        reopen=partial(open_selected_frames, path, names, height),
    )


def open_simulated_scans(params: Any, folder: Path, count: int) -> Recording:
    """Return simulated test scans as a recording. Each scan is computed once and cached on disk."""
    scenes = Scenes(None, params.data.val_people, params.scene)
    source = SimulatedScenes(
        FIRST_TEST_SCENE,
        count,
        find_sensor(params.sensor, params.mount_height),
        scenes,
        folder,
        params.data.cache_gb,
        all_around=getattr(params, "range", "") == "around",
    )
    has = frozenset({BOXES, CAMERA} if scenes.camera else {BOXES})
    return Recording(
        Path(SIM),
        f"simulated {params.scene}",
        TestFrames(source),
        has,
        reopen=partial(open_simulated_scans, params, folder, count),
        is_sequential=False,
    )


class TestFrames(ComputedFrames):
    """Simulated frames whose scans are computed when their content is read."""

    __test__ = False  # keeps pytest from collecting the class

    def __init__(self, source: SimulatedScenes) -> None:
        self.source = source

    def __len__(self) -> int:
        return len(self.source)

    def compute_frame(self, number: int) -> Frame:
        load_frame = cache(partial(self.source.load_frame, number))
        seed, _ = self.source.locate(number)
        return Frame(
            f"scene {seed}",
            0,
            lambda: load_frame().load(),
            lambda: load_frame().truth(),
            calibration=lambda: load_frame().calibration(),
            sensor_height=self.source.sensor.height,
        )

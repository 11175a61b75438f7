"""Sources of training and validation scenes."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from lidar_perception.simulation.drive import count_drive_scans
from lidar_perception.simulation.scene import Scenes
from lidar_perception.simulation.sensor import HDL64E, Sensor
from lidar_perception.training.frames import open_labelled_frames
from lidar_perception.training.request import TrainingRequest
from lidar_perception.training.scenes import RecordedScenes, SimulatedScenes
from lidar_perception.types import InputError

SIM = "sim"  # stands for simulated scenes in place of a path
# First seeds of the scenes for training, validation and the fit of curves; far from all other seeds.
FIRST_TRAINING_SEED, FIRST_VALIDATION_SEED, FIRST_FIT_SEED = 10_000_000, 20_000_000, 30_000_000


def open_sources(request: TrainingRequest, params: Any, sensor: Sensor = HDL64E) -> tuple[tuple, tuple]:
    """Open the sources of training and validation scenes, which share no frame.

    Args:
        request: Data and splits.
        sensor: Sensor of the simulated scans.

    Returns:
        Training sources and validation sources.

    Raises:
        InputError: A file is missing, or an option would have no effect.
    """
    data, val, split, val_split = request.data, request.val, request.split, request.val_split
    folders = [Path(name) for name in data if name != SIM]
    val_folders = [Path(name) for name in val if name != SIM] or ([] if val else folders)
    if split is not None and len(folders) != 1:
        raise InputError("--split requires exactly one recording to train on")
    if val_split is not None and len(val_folders) != 1:
        raise InputError("--val-split requires exactly one recording in --val")
    with_simulated = SIM in (*data, *val)
    open_frames = partial(open_labelled_frames, height=params.mount_height, with_simulated=with_simulated)
    train_frames = [open_frames(folder, split) for folder in folders]
    if val or val_split is not None:
        val_frames = [open_frames(folder, val_split) for folder in val_folders]
    else:
        splits = [frames.split(params.data.val_share, params.seed) for frames in train_frames]
        train_frames, val_frames = [split[0] for split in splits], [split[1] for split in splits]
    if split is not None and val_split is None:  # --split has priority
        val_frames = [frames.exclude(train_frames, "validate on") for frames in val_frames]
    else:
        train_frames = [frames.exclude(val_frames, "train on") for frames in train_frames]
    numbers = params.data
    sources: list[RecordedScenes | SimulatedScenes] = [frames.to_scenes(numbers.view) for frames in train_frames]
    val_sources: list[RecordedScenes | SimulatedScenes] = [frames.to_scenes(numbers.view) for frames in val_frames]
    simulate = partial(
        SimulatedScenes, sensor=sensor, cache_gb=numbers.cache_gb, cache=Path(numbers.cache) if numbers.cache else None
    )
    scenes, val_scenes = Scenes(None, numbers.people, params.scene), Scenes(None, numbers.val_people, params.scene)
    if with_simulated:
        scenes.scene_types()  # raises InputError for an unknown scene
    if SIM in data:
        scans_per_scene = min(numbers.street_scans, count_drive_scans(sensor))
        sources.append(simulate(FIRST_TRAINING_SEED, numbers.scans, scenes=scenes, scans_per_scene=scans_per_scene))
    if SIM in (val or data):
        all_around = getattr(params, "range", "") == "around"
        val_sources.append(simulate(FIRST_VALIDATION_SEED, numbers.val_scans, scenes=val_scenes, all_around=all_around))
    return tuple(sources), tuple(val_sources)

"""Which scenes a network is trained on and which it is validated on."""

from __future__ import annotations

from collections.abc import Sized
from functools import partial
from pathlib import Path
from typing import Any

from lidar_perception.simulation.drive import longest_drive
from lidar_perception.simulation.scene import Scenes
from lidar_perception.simulation.sensor import HDL64E, Sensor
from lidar_perception.training.frames import labelled_frames
from lidar_perception.training.params import DataParams
from lidar_perception.training.scenes import RecordedScenes, SimulatedScenes
from lidar_perception.types import InputError

SIM = "sim"  # the name of simulated scenes where a folder could stand
# Of scenes to train on, to validate on, and to fit curves to: far from what anybody else takes.
FIRST_SCENE, FIRST_VALIDATION_SCENE, FIRST_FITTED_SCENE = 10_000_000, 20_000_000, 30_000_000


def training_scenes(data: tuple[str, ...], val: tuple[str, ...], split: Path | None,
                    val_split: Path | None, settings: DataParams, seed: int,
                    sensor: Sensor = HDL64E, around: bool = False,
                    scene: str = "street", height: float = 0.0) -> tuple[tuple, tuple]:
    """Sources to train on and to validate on, which have no frame in common. sensor: of simulated
    scenes, which are those of scene, see Scenes; around: validate on what lies all around; height:
    see labelled_frames. InputError for what is not there, or an option that would not be used."""
    folders = [Path(name) for name in data if name != SIM]
    val_folders = [Path(name) for name in val if name != SIM] or ([] if val else folders)
    if split is not None and len(folders) != 1:
        raise InputError("--split names frames of one recording in --data; give one")
    if val_split is not None and len(val_folders) != 1:
        raise InputError("--val-split names frames of one recording; give one in --val")
    mixed = SIM in (*data, *val)
    learned = [labelled_frames(folder, split, height, mixed) for folder in folders]
    if val or val_split is not None:
        held = [labelled_frames(folder, val_split, height, mixed) for folder in val_folders]
    else:
        pairs = [one.held_out(settings.val_share, seed) for one in learned]
        learned, held = [one for one, _ in pairs], [one for _, one in pairs]
    if split is not None and val_split is None:  # what is named stays what it is
        held = [one.without(learned, "validate on") for one in held]
    else:
        learned = [one.without(held, "train on") for one in learned]
    train_on: list[RecordedScenes | SimulatedScenes] = [
        one.scenes(settings.view) for one in learned]
    judge_on: list[RecordedScenes | SimulatedScenes] = [one.scenes(settings.view) for one in held]
    simulated = partial(SimulatedScenes, sensor=sensor, cache_gb=settings.cache_gb,
                        cache=Path(settings.cache) if settings.cache else None)
    if SIM in (*data, *val):
        Scenes(None, settings.people, scene).sorts()  # InputError before anything is made
    if SIM in data:
        train_on.append(simulated(FIRST_SCENE, settings.scans,
                                  scenes=Scenes(None, settings.people, scene),
                                  per_scene=min(settings.street_scans, longest_drive(sensor))))
    if SIM in (val or data):
        judge_on.append(simulated(FIRST_VALIDATION_SCENE, settings.val_scans,
                                  scenes=Scenes(None, settings.val_people, scene), around=around))
    return tuple(train_on), tuple(judge_on)


def about_data(data: tuple[str, ...], val: tuple[str, ...], stream: Sized,
               held_out: tuple[Sized, ...], init: Path | None) -> dict[str, Any]:
    """What a header says of the scenes."""
    return {"data": list(data), "scenes": len(stream), "validation": list(val) or "held out",
            "validation_scenes": sum(map(len, held_out)), "init": str(init or "")}

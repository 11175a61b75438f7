"""Builders for tests of training: a toy network, readers of the files of a run, parameters without
augmentation, and a folder with broken frames."""

from __future__ import annotations

import csv
from pathlib import Path

import torch
from samples import make_walker_label, write_file, write_object_folder
from torch import nn

from lidar_perception.training.distributed import get_rank, get_world_size
from lidar_perception.training.params import AugmentParams, LoopParams
from lidar_perception.training.run import Task
from lidar_perception.training.run_directory import STATE

PARAMS = LoopParams(steps=13, validate_steps=4, save_steps=3, log_steps=1, seed=3, lr=0.05, amp="off")


class Toy:
    """Regression network with dropout and batch norm. The loss of each step calls before(step)."""

    def __init__(self, before=lambda step: None, plain: bool = False, size: int = 8):
        torch.manual_seed(5)
        middle = [] if plain else [nn.BatchNorm1d(6), nn.Dropout(0.3)]
        self.module = nn.Sequential(nn.Linear(4, 6), *middle, nn.ReLU(), nn.Linear(6, 1))
        self.before, self.size, self.saved = before, size, {}

    def task(self, **about) -> Task:
        return Task(self.module, self.loss, self.batches, self.validate, self.save, 4, about)

    def loss(self, module, batch):
        step, inputs, target = batch
        self.before(step)
        error = (module(inputs) - target).square().mean()
        return error, {"half": error.detach() / 2}

    def batches(self, step):
        while True:
            rng = torch.Generator().manual_seed(step)
            inputs = torch.randn(self.size * get_world_size(), 4, generator=rng)
            inputs = inputs[get_rank() * self.size : (get_rank() + 1) * self.size]
            yield step, inputs, inputs[:, :1] * 2 - inputs[:, 1:2]
            step += 1

    def validate(self, module):
        assert not module.training
        inputs = torch.linspace(-1, 1, 40).view(10, 4)
        with torch.no_grad():
            error = (module(inputs) - inputs[:, :1] * 2 + inputs[:, 1:2]).square().mean()
        return {"score": -error.item()}, {}

    def save(self, name, module, record):
        state = {k: v.clone() for k, v in module.state_dict().items()}
        self.saved[name] = state, record


def weights(folder: Path) -> dict[str, torch.Tensor]:
    state = torch.load(folder / STATE, weights_only=True)
    return {f"{part}.{name}": value for part in ("module", "average") for name, value in state[part].items()}


def are_equal(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def read_rows(folder: Path, name: str = "log.csv") -> list[dict]:
    with open(folder / name) as stream:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(stream)]


def are_equal_runs(folder: Path, other: Path) -> bool:
    """Return True if two runs wrote the same files, apart from durations."""
    return (
        are_equal(weights(folder), weights(other))
        and read_rows(folder) == read_rows(other)
        and read_rows(folder, "validation.csv") == read_rows(other, "validation.csv")
    )


STILL = AugmentParams(
    cars=0,
    pedestrians=0,
    cyclists=0,
    things=0,
    object_turn=0,
    object_shift=0,
    flip=0,
    turn=0,
    scale=0,
    beam_noise=0,
    range_noise=0,
    dropout=0,
    intensity=0,
    no_intensity=0,
    fade=0,
    quantize=0,
    speckle=0,
    height=0,
    tilt=0,
)


def broken_folder(root):
    """Write five frames, of which 1 has a broken label file and 3 a truncated scan."""
    write_object_folder(root, make_walker_label() + "\n", 5)
    write_file(root / "training/label_2/000001.txt", "Pedestrian 0 0 x\n")
    scan = root / "training/velodyne/000003.bin"
    scan.write_bytes(scan.read_bytes()[:-5])
    return root


def prepare_all(scene, rng):
    """Stand-in for the preparation of samples; returns its input and a random number."""
    return scene.points.sum(), scene.boxes, rng.random()

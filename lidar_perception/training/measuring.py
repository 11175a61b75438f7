"""How long things take here."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from typing import Any, TypeVar

import torch
from torch import nn

from lidar_perception.detectors.devices import number_format
from lidar_perception.runs.machine import cores
from lidar_perception.training.data import Item, ReadScenes
from lidar_perception.training.params import LoopParams
from lidar_perception.types import InputError

MOST = 4  # scenes with which it is measured

Result = TypeVar("Result")


def timed(work: Callable[[], Result]) -> tuple[float, Result]:
    """Seconds, and what work() gives."""
    begun = time.perf_counter()
    result = work()
    return time.perf_counter() - begun, result


def usable(scenes: Iterable[Item], prepare: Callable[[Any], Any]) -> list[Any]:
    """The first scenes, at most MOST, of which prepare(scene) can make something. InputError, with
    the first reason, where there is none."""
    chosen: list[Any] = []
    reasons: list[str] = []
    for scene, skipped in scenes:
        reasons += skipped
        if scene is None:
            continue
        try:
            prepare(scene)
        except InputError as error:
            reasons.append(str(error))
            continue
        chosen.append(scene)
        if len(chosen) == MOST:
            break
    if not chosen:
        raise InputError("no scene to train on can be used "
                         f"({next(iter(reasons), 'there is none')})")
    return chosen


def first_read(scenes: ReadScenes, enough: Callable[[Any], bool] = lambda _: True) -> Any:
    """The first of the scenes to validate on that can be read and has enough in it; where none has,
    the first that can be read. InputError, with the first reason, where there is none."""
    other: Any = None
    reasons: list[str] = []
    for n in range(len(scenes)):
        sample, skipped = scenes[n]
        reasons += skipped
        if sample is not None and enough(sample):
            return sample
        other = sample if other is None else other
    if other is None:
        raise InputError("no frame to validate on can be used "
                         f"({next(iter(reasons), 'there is none')})")
    return other


def seconds_of_step(module: nn.Module, loss: Callable, prepare: Callable[[], Sequence[Any]],
                    params: LoopParams, device: torch.device) -> float:
    """Seconds of a step of training a module, which it spoils, with the samples that prepare()
    gives in processes of their own."""
    prepare()  # so that what is compiled is there
    preparing, samples = timed(prepare)
    batch = [samples[i % len(samples)] for i in range(params.batch)]
    amp = number_format(params.amp, device)

    def step() -> None:  # in this process alone, whatever others there are
        with torch.autocast(device.type, amp) if amp else nullcontext():
            total, _ = loss(module, batch)
        total.backward()
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    module.train()
    step()
    return timed(step)[0] + preparing / len(samples) * params.batch / cores()

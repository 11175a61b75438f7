"""Measurement of how long the parts of a training run take."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from typing import Any, TypeVar

import torch
from torch import nn

from lidar_perception.detectors.devices import choose_dtype
from lidar_perception.runs.machine import count_cores
from lidar_perception.training.data import Item, SceneReader
from lidar_perception.training.params import LoopParams
from lidar_perception.types import InputError

MAX_TIMED_SCENES = 4

Result = TypeVar("Result")


def measure_duration(work: Callable[[], Result]) -> tuple[float, Result]:
    """Return the duration of work() in seconds, and its result."""
    start = time.perf_counter()
    result = work()
    return time.perf_counter() - start, result


def select_usable_scenes(scenes: Iterable[Item], prepare: Callable[[Any], Any]) -> list[Any]:
    """Return the first scenes, at most MAX_TIMED_SCENES, for which prepare(scene) raises no InputError.

    Raises:
        InputError: There is no such scene. The message contains the first reason.
    """
    usable_scenes: list[Any] = []
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
        usable_scenes.append(scene)
        if len(usable_scenes) == MAX_TIMED_SCENES:
            break
    if not usable_scenes:
        raise InputError(f"no usable training scene ({next(iter(reasons), 'there are no scenes')})")
    return usable_scenes


def find_readable_frame(scenes: SceneReader, is_typical: Callable[[Any], bool]) -> Any:
    """Return the first validation frame that is typical, or the first readable one if none is.

    Raises:
        InputError: No frame can be read. The message contains the first reason.
    """
    fallback: Any = None
    reasons: list[str] = []
    for n in range(len(scenes)):
        sample, skipped = scenes[n]
        reasons += skipped
        if sample is not None and is_typical(sample):
            return sample
        fallback = sample if fallback is None else fallback
    if fallback is None:
        raise InputError(f"no usable validation frame ({next(iter(reasons), 'there are no frames')})")
    return fallback


def measure_step(
    module: nn.Module, loss: Callable, prepare: Callable[[], Sequence[Any]], params: LoopParams, device: torch.device
) -> float:
    """Measure the duration of one training step in seconds, including the preparation of its samples on all cores.

    Args:
        module: Network to train; its gradients and statistics change.
        loss: loss(module, batch), as in run.Task.
        prepare: Function that returns a few samples.
        params: Batch size and number format.
        device: Device of the network.
    """
    prepare()  # triggers compilation of kernels
    preparation, samples = measure_duration(prepare)
    batch = [samples[i % len(samples)] for i in range(params.batch)]
    amp = choose_dtype(params.amp, device)

    def step() -> None:  # runs in this process only, even in distributed training
        with torch.autocast(device.type, amp) if amp else nullcontext():
            total, _ = loss(module, batch)
        total.backward()
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    module.train()
    step()
    duration, _ = measure_duration(step)
    return duration + preparation / len(samples) * params.batch / count_cores()

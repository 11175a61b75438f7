"""How long things take here."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import nn

from lidar_perception.runs.machine import cores
from lidar_perception.training.params import LoopParams
from lidar_perception.training.run import Run, Task

Result = TypeVar("Result")


def timed(work: Callable[[], Result]) -> tuple[float, Result]:
    """Seconds, and what work() gives."""
    begun = time.perf_counter()
    result = work()
    return time.perf_counter() - begun, result


def seconds_of_step(module: nn.Module, loss: Callable, prepare: Callable[[], Sequence[Any]],
                    params: LoopParams, device: torch.device) -> float:
    """Seconds of a step of training a module, which it spoils, with the samples that prepare()
    gives in processes of their own."""
    prepare()  # so that what is compiled is there
    preparing, samples = timed(prepare)
    run = Run(Task(module, loss, lambda _: (), lambda _: {}, lambda *_: None, 1), params, device)
    batch = [samples[i % len(samples)] for i in range(params.batch)]
    run.step(batch)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return (timed(lambda: run.step(batch))[0]
            + preparing / len(samples) * params.batch / cores())

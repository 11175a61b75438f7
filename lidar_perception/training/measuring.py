"""How long things take here."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from typing import Any, TypeVar

import torch
from torch import nn

from lidar_perception.runs.machine import cores
from lidar_perception.training.params import LoopParams
from lidar_perception.training.run import number_format

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

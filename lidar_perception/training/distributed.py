"""Communication between the processes of a training run that torchrun started.

A run in a single process has rank 0 and world size 1.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta

import torch
from torch import distributed

TIMEOUT = timedelta(hours=2)  # time that the other processes wait while rank 0 validates


@contextmanager
def join_process_group(device: torch.device) -> Iterator[torch.device]:
    """Join the processes that torchrun started, if any, and yield the device of this process."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield device
        return
    if device.type == "cuda":
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
        torch.cuda.set_device(device)
    if distributed.is_initialized():
        yield device
        return
    distributed.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=TIMEOUT)
    try:
        yield device
    finally:
        distributed.destroy_process_group()


def get_rank() -> int:
    """Return the rank of this process, from 0."""
    return distributed.get_rank() if distributed.is_initialized() else 0


def get_world_size() -> int:
    """Return the number of processes."""
    return distributed.get_world_size() if distributed.is_initialized() else 1


def is_true_anywhere(flag: bool, device: torch.device) -> bool:
    """Return True if flag is True in any process. All processes must call this."""
    return find_minimum(-float(flag), device) < 0


def find_minimum(number: float, device: torch.device) -> float:
    """Return the minimum of a number over all processes. All processes must call this."""
    if get_world_size() == 1:
        return number
    value = torch.tensor(number, device=device)
    distributed.all_reduce(value, distributed.ReduceOp.MIN)
    return float(value.item())


def wait_for_all() -> None:
    """Wait until all processes have called this."""
    if get_world_size() > 1:
        distributed.barrier()

"""Where a network runs: the CPU or CUDA."""

from __future__ import annotations

import torch

from lidar_perception.types import InputError

CPU = torch.device("cpu")


def chosen_device(name: str = "auto") -> torch.device:
    """The torch device of 'auto', 'cpu', 'cuda' or 'cuda:N'. InputError if it is not there."""
    available = torch.cuda.is_available()
    if name == "auto":
        return torch.device("cuda" if available else "cpu")
    try:
        device = torch.device(name)
        if device.type not in ("cpu", "cuda"):
            raise RuntimeError
    except RuntimeError:
        raise InputError(f"there is no device {name!r}; choose auto, cpu, cuda or cuda:N") from None
    if device.type == "cuda" and not (available and (device.index or 0)
                                      < torch.cuda.device_count()):
        raise InputError(f"device {name!r} is asked for but torch finds "
                         f"{torch.cuda.device_count() if available else 'no'} CUDA device here; "
                         "choose auto or cpu")
    return device

"""Device and number format of a network."""

from __future__ import annotations

import torch

from lidar_perception.runs.machine import has_bf16
from lidar_perception.types import InputError

CPU = torch.device("cpu")
FORMATS = {"bf16": torch.bfloat16, "fp16": torch.float16}


def find_device(name: str = "auto") -> torch.device:
    """Return the torch device for 'auto', 'cpu', 'cuda' or 'cuda:N'.

    Raises:
        InputError: the name is unknown, or the machine has no such device.
    """
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
        raise InputError(f"device {name!r} is not available: torch finds "
                         f"{torch.cuda.device_count() if available else 'no'} CUDA device here; "
                         "choose auto or cpu")
    return device


def choose_dtype(amp: str, device: torch.device) -> torch.dtype | None:
    """Return the dtype of a network's layers; None for float32.

    Args:
        amp: off, bf16, fp16 (CUDA only), or auto: 16 bits if the device has instructions for it.
    """
    if device.type == "cpu":
        return FORMATS["bf16"] if amp == "bf16" or (amp == "auto" and has_bf16()) else None
    if amp == "off":
        return None
    if amp == "auto":
        amp = "bf16" if torch.cuda.is_bf16_supported() else "fp16"
    return FORMATS[amp]

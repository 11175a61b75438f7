"""Device and number format of a network.

Devices are given by name, such as cpu or cuda:1. torch is imported only if a GPU may be used.
"""

from __future__ import annotations

import ctypes
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from lidar_perception.runs.machine import has_bf16
from lidar_perception.types import InputError

if TYPE_CHECKING:
    import torch

CPU = "cpu"


def find_device(name: str = "auto") -> str:
    """Resolve and check a device name: 'auto', 'cpu', 'cuda' or 'cuda:N'.

    Raises:
        InputError: the name is unknown, or the machine has no such device.
    """
    if name == CPU or (name == "auto" and not _has_gpu_driver()):
        return CPU
    match = re.fullmatch(r"auto|cuda(?::(\d+))?", name)
    if not match:
        raise InputError(f"unknown device {name!r}; choose auto, cpu, cuda or cuda:N")
    import torch  # slow to import

    device_count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if name == "auto":
        return "cuda" if device_count else CPU
    if int(match[1] or 0) >= device_count:
        raise InputError(
            f"device {name!r} is not available (CUDA devices found by torch: {device_count}); choose auto or cpu"
        )
    return name


def _has_gpu_driver() -> bool:
    """Return True if this machine has an NVIDIA or AMD driver, or torch is already imported."""
    if "torch" in sys.modules or Path("/dev/kfd").exists():
        return True
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return True


def uses_bf16_on_cpu(amp: str) -> bool:
    """Return True if the parameter `amp` selects bf16 on the CPU, see params.make_amp_param."""
    return amp == "bf16" or (amp == "auto" and has_bf16())


def choose_dtype(amp: str, device: str | torch.device) -> torch.dtype | None:
    """Return the autocast dtype of a network's layers; None for float32.

    Args:
        amp: off, bf16, fp16 (CUDA only), or auto for 16 bits if the device supports it.
    """
    import torch

    if torch.device(device).type == CPU:
        return torch.bfloat16 if uses_bf16_on_cpu(amp) else None
    if amp == "off":
        return None
    if amp == "auto":
        amp = "bf16" if torch.cuda.is_bf16_supported() else "fp16"
    return {"bf16": torch.bfloat16, "fp16": torch.float16}[amp]


def is_out_of_memory(error: RuntimeError) -> bool:
    """Return True if torch raised this error because a GPU is out of memory."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(error, torch.cuda.OutOfMemoryError)

"""Random numbers that depend on nothing but a key: a counter-based hash in torch."""

from __future__ import annotations

import torch


def uniform(seed: int, key: torch.Tensor) -> torch.Tensor:
    """float64 in the open interval 0 .. 1 for each int64 key; the same on every device, in any
    order and in any batch. The finalizer is splitmix64's (Steele, Lea and Flood, OOPSLA 2014)."""
    bits = _shifted(mixed(mixed(key) + signed(seed * 0x9E3779B97F4A7C15)), 12)
    return (bits.to(torch.float64) + 0.5) * 2.0 ** -52


def mixed(x: torch.Tensor) -> torch.Tensor:
    """int64 to int64, one to one."""
    x = (x ^ _shifted(x, 30)) * signed(0xBF58476D1CE4E5B9)
    x = (x ^ _shifted(x, 27)) * signed(0x94D049BB133111EB)
    return x ^ _shifted(x, 31)


def _shifted(x: torch.Tensor, bits: int) -> torch.Tensor:
    """A logical shift to the right."""
    return x >> bits & (1 << 64 - bits) - 1


def signed(number: int) -> int:
    """The lowest 64 bits of a whole number, as those of an int64."""
    return (number + (1 << 63)) % (1 << 64) - (1 << 63)

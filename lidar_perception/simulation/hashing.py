"""Compiled counter-based random numbers: pure functions of a key."""

from __future__ import annotations

import numpy as np
from numba import njit

GOLDEN_GAMMA, MULTIPLIER_1, MULTIPLIER_2 = (
    np.uint64(n) for n in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
)


@njit(cache=True, nogil=True)
def hash_uniform(seed, key):
    """Return a random float64, uniform in the open interval (0, 1), for a uint64 key and a small seed."""
    bits = mix_bits(mix_bits(key) + np.uint64(seed) * GOLDEN_GAMMA) >> np.uint64(12)
    return (np.float64(bits) + 0.5) * 2.0**-52


@njit(cache=True, nogil=True)
def mix_bits(x):
    """Hash a uint64 with the finalizer of splitmix64 (Steele, Lea and Flood, OOPSLA 2014)."""
    x = (x ^ (x >> np.uint64(30))) * MULTIPLIER_1
    x = (x ^ (x >> np.uint64(27))) * MULTIPLIER_2
    return x ^ (x >> np.uint64(31))

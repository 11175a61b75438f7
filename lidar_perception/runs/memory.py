"""Freed memory that stays with the process, for the next cloud."""

from __future__ import annotations

import ctypes
import os

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's mallopt
KEPT = 2**30     # bytes
LARGEST = 2**25  # what older versions take at most for the second
THE_USERS = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")


def keep_freed() -> None:
    """For glibc: what a network or an array of a cloud leaves goes to the next one, instead of back
    to the system, which gives it out again page by page, each filled with zeros: PointPillars then
    takes 77 ms instead of 91, the most memory in use is the same, and the process stays at it. What
    the user has set in the environment stays; of other libraries nothing changes."""
    if any(name in os.environ for name in THE_USERS):
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return
    mallopt(M_TRIM_THRESHOLD, KEPT)
    if not mallopt(M_MMAP_THRESHOLD, KEPT):
        mallopt(M_MMAP_THRESHOLD, LARGEST)

"""Setting of glibc that keeps freed memory in the process for the next cloud."""

from __future__ import annotations

import ctypes
import os

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # options of glibc's mallopt
THRESHOLD_BYTES = 2**30  # value of both options
MAX_MMAP_THRESHOLD_BYTES = 2**25  # maximum of M_MMAP_THRESHOLD in older versions of glibc
USER_VARIABLES = (  # environment variables with which a user sets these options
    "MALLOC_TRIM_THRESHOLD_",
    "MALLOC_MMAP_THRESHOLD_",
    "GLIBC_TUNABLES",
)


def keep_freed_memory() -> None:
    """Make glibc keep freed memory instead of returning it to the system.

    Then the system does not have to zero the pages again, and PointPillars takes 77 instead of 91
    ms. The peak memory is the same, but the process does not shrink afterwards. Settings of the
    user in the environment take precedence. Other C libraries are not affected.
    """
    if any(name in os.environ for name in USER_VARIABLES):
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return
    mallopt(M_TRIM_THRESHOLD, THRESHOLD_BYTES)
    if not mallopt(M_MMAP_THRESHOLD, THRESHOLD_BYTES):
        mallopt(M_MMAP_THRESHOLD, MAX_MMAP_THRESHOLD_BYTES)

"""What Fast DDS keeps in shared memory: how much of it, and what killed processes left there."""

from __future__ import annotations

import fcntl
import os
import re
import sys
import time
from pathlib import Path

SHARED = Path("/dev/shm")
LOCK_OF_A_SEGMENT = re.compile(r"(fastrtps_[0-9a-f]{16})_el")
SETTLED = 60.0  # seconds; what is younger is left alone
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
PROFILES = {256 * 2**20: "fastdds.xml", 40 * 2**20: "fastdds_small.xml"}  # free bytes needed
DRIVER_PROFILE, SOCKET_BUFFER = "fastdds_driver.xml", 2 * 2**20  # bytes of net.core.rmem_max needed


def use_large_shared_memory(from_driver: bool = False) -> None:
    """Let Fast DDS pass whole clouds through shared memory, see fastdds.xml; less of it where
    /dev/shm is small, as the 64 MB of a container are. With from_driver, clouds come by UDP where
    the socket's buffer can hold one, see fastdds_driver.xml. A profile of the user's own stays."""
    if any(os.environ.get(name) for name in PROFILE_VARIABLES):
        return
    remove_dead_segments()
    try:
        memory = os.statvfs(SHARED)
    except OSError:
        return
    free = memory.f_bavail * memory.f_frsize
    profile = next((name for needed, name in PROFILES.items() if free >= needed), None)
    if profile != "fastdds.xml":
        print(f"/dev/shm has only {free / 2**20:.0f} MB free, so clouds above "
              f"{3 if profile else 0} MB may get lost between processes; start the container with "
              "--shm-size=1g", file=sys.stderr)
    if from_driver and profile == "fastdds.xml" and socket_buffer() >= SOCKET_BUFFER:
        profile = DRIVER_PROFILE
    if profile:
        for name in PROFILE_VARIABLES:
            os.environ[name] = str(Path(__file__).with_name(profile))


def remove_dead_segments(folder: Path = SHARED) -> None:
    """Remove the segments of our user's processes that were killed, and say so on stderr. Fast DDS
    leaves them, with fastdds.xml 67 MB a process, until /dev/shm is full and clouds get lost. A
    process that lives holds a lock on its segment's file NAME_el, for as long as it lives."""
    removed = size = 0
    for lock in folder.glob("fastrtps_*_el"):
        name = LOCK_OF_A_SEGMENT.fullmatch(lock.name)
        try:
            told = lock.stat()
            if name is None or told.st_uid != os.getuid() or time.time() - told.st_mtime < SETTLED:
                continue
            with open(lock, "rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                segment = folder / name[1]
                size += segment.stat().st_size
                segment.unlink()
                lock.unlink()
                removed += 1
        except OSError:  # alive, or another node was quicker
            continue
    if removed:
        print(f"removed {removed} shared-memory segments ({size / 1e6:.0f} MB) that killed "
              f"processes left in {folder}", file=sys.stderr)


def socket_buffer() -> int:
    """net.core.rmem_max, bytes that a socket may hold; 0 where it is not known."""
    try:
        return int(Path("/proc/sys/net/core/rmem_max").read_text())
    except (OSError, ValueError):
        return 0


def fed_by_a_driver(arguments: list[str]) -> bool:
    """Whether a node's clouds come from outside: those of our nodes are NODE/output/points."""
    return not any(word.endswith("/output/points") for word in arguments)

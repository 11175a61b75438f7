"""Configuration and cleanup of the shared memory of Fast DDS."""

from __future__ import annotations

import fcntl
import os
import re
import sys
import time
from pathlib import Path

SHARED_MEMORY = Path("/dev/shm")
LOCK_NAME = re.compile(r"(fastrtps_[0-9a-f]{16})_el")
MIN_AGE_S = 60.0  # minimum age of a segment that may be removed
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
PROFILES = {256 * 2**20: "fastdds.xml", 40 * 2**20: "fastdds_small.xml"}  # required free bytes -> profile
DRIVER_PROFILE = "fastdds_driver.xml"
SOCKET_BUFFER = 2 * 2**20  # minimum net.core.rmem_max for DRIVER_PROFILE, in bytes


def use_large_shared_memory(is_fed_by_driver: bool = False) -> None:
    """Configure Fast DDS to pass complete clouds through shared memory, see fastdds.xml.

    If /dev/shm is small, such as the 64 MB of a container, segments are smaller. A profile that the
    user has set is not changed.

    Args:
        is_fed_by_driver: receive clouds by UDP if the socket buffer can hold one, see
            fastdds_driver.xml.
    """
    if any(os.environ.get(name) for name in PROFILE_VARIABLES):
        return
    remove_dead_segments()
    try:
        memory = os.statvfs(SHARED_MEMORY)
    except OSError:
        return
    free_bytes = memory.f_bavail * memory.f_frsize
    profile = next((name for required_bytes, name in PROFILES.items() if free_bytes >= required_bytes), None)
    if profile != "fastdds.xml":
        print(
            f"/dev/shm has only {free_bytes / 2**20:.0f} MB free, so clouds above "
            f"{3 if profile else 0} MB may be lost between processes; start the container with "
            "--shm-size=1g",
            file=sys.stderr,
        )
    if is_fed_by_driver and profile == "fastdds.xml" and read_socket_buffer_size() >= SOCKET_BUFFER:
        profile = DRIVER_PROFILE
    if profile:
        for name in PROFILE_VARIABLES:
            os.environ[name] = str(Path(__file__).with_name(profile))


def remove_dead_segments(folder: Path = SHARED_MEMORY) -> None:
    """Remove segments of killed processes of this user, and report it on stderr.

    Fast DDS does not remove them (67 MB per process with fastdds.xml), so that /dev/shm fills up and
    clouds are lost. A running process holds a lock on the file NAME_el of its segment.
    """
    removed_count = size = 0
    for lock in folder.glob("fastrtps_*_el"):
        name = LOCK_NAME.fullmatch(lock.name)
        try:
            status = lock.stat()
            is_recent = time.time() - status.st_mtime < MIN_AGE_S
            if name is None or status.st_uid != os.getuid() or is_recent:
                continue
            with open(lock, "rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                segment = folder / name[1]
                size += segment.stat().st_size
                segment.unlink()
                lock.unlink()
                removed_count += 1
        except OSError:  # in use, or already removed by another node
            continue
    if removed_count:
        print(
            f"removed {removed_count} shared-memory segments ({size / 1e6:.0f} MB) of killed processes from {folder}",
            file=sys.stderr,
        )


def read_socket_buffer_size() -> int:
    """Return the maximum size of a socket buffer (net.core.rmem_max) in bytes; 0 if it is unknown."""
    try:
        return int(Path("/proc/sys/net/core/rmem_max").read_text())
    except (OSError, ValueError):
        return 0


def reads_driver_clouds(arguments: list[str]) -> bool:
    """Return True if no argument names the cloud of another node of this package (NODE/output/points)."""
    return not any(word.endswith("/output/points") for word in arguments)

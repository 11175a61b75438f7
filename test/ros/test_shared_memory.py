"""Shared memory of Fast DDS: the profile of a node, and cleaning up after killed processes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from time import monotonic
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from lidar_perception.nodes import shared_memory
from lidar_perception.nodes.graph import reserve_domain
from lidar_perception.nodes.shared_memory import PROFILE_VARIABLES


@pytest.mark.parametrize(
    "remap, buffer, profile",
    [
        ("~/input/points:=/velodyne_points", 8 << 20, "fastdds_driver.xml"),
        ("~/input/points:=/velodyne_points", 212_992, "fastdds.xml"),
        ("~/input/points:=clustering/output/points", 8 << 20, "fastdds.xml"),
    ],
)
def test_driver_clouds_use_udp_with_large_socket_buffer(remap, buffer, profile, monkeypatch):
    monkeypatch.setattr(shared_memory, "read_socket_buffer_size", lambda: buffer)
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_bavail=1 << 20, f_frsize=4096))
    for name in PROFILE_VARIABLES:
        monkeypatch.setenv(name, "")
    arguments = ["pointpillars_detector", "--ros-args", "-r", remap]
    shared_memory.use_large_shared_memory(shared_memory.reads_driver_clouds(arguments))
    assert {Path(os.environ[name]).name for name in PROFILE_VARIABLES} == {profile}
    assert Path(os.environ[PROFILE_VARIABLES[0]]).is_file()
    shared_memory.use_large_shared_memory(True)  # existing settings are kept
    assert Path(os.environ[PROFILE_VARIABLES[0]]).name == profile


def find_segments(pid: int | str) -> set[Path]:
    """Return the segments that a process has open: its own and others of its domain."""
    with suppress(OSError):  # the process has ended, or belongs to another user
        maps = Path(f"/proc/{pid}/maps").read_text()
        return {Path(p) for p in re.findall(r"/dev/shm/fastrtps_[0-9a-f]{16}$", maps, re.M)}
    return set()


def shares_no_segment(process) -> bool:
    """Return True if a process shares no segment with another process."""
    return all(
        find_segments(process.pid).isdisjoint(find_segments(other.name))
        for other in Path("/proc").glob("[0-9]*")
        if other.name != str(process.pid)
    )


def start_short_process():
    """Start a process shares_no_segment in its domain."""
    code = "import rclpy; rclpy.init(); node = rclpy.create_node('short'); print(); input()"
    while True:
        process = subprocess.Popen(
            [sys.executable, "-c", code],
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "ROS_DOMAIN_ID": str(reserve_domain())},
        )
        process.stdout.readline()
        if shares_no_segment(process):
            return process
        process.communicate("\n")


def test_only_shared_memory_of_killed_process_is_removed(capsys):
    with start_short_process() as killed, start_short_process() as living:
        theirs, others = find_segments(killed.pid), find_segments(living.pid)

        def remove_as_if_old():
            """Make the segments look old only during the call, because other starting nodes would remove them."""
            for age in (0, 0), None:
                for segment in theirs | others:
                    with suppress(FileNotFoundError):
                        os.utime(f"{segment}_el", age)
                if age:
                    shared_memory.remove_dead_segments()

        remove_as_if_old()
        assert theirs and others and all(segment.exists() for segment in theirs | others)
        killed.kill()
        killed.wait()
        end = monotonic() + 10
        while (left := [s for s in theirs if s.exists() or Path(f"{s}_el").exists()]) and monotonic() < end:
            remove_as_if_old()  # another starting node may hold their locks
        assert not left
        assert all(segment.exists() for segment in others)
        living.kill()
    assert "of killed processes from /dev/shm" in capsys.readouterr().err

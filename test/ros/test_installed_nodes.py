"""The installed executables exit with 0 at SIGINT and SIGTERM at any time after their start, and leave no shared
memory."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path
from time import monotonic, sleep

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from lidar_perception.data.bag import Bag
from lidar_perception.nodes.main import STOP_SIGNALS
from lidar_perception.wire.codec import make_bag_message

PREFIX = Path(sys.prefix)
STARTED_BY = {
    "ros2 run": lambda node: [PREFIX / "lib/lidar_perception" / node],
    "lidar-perception run": lambda node: [PREFIX / "bin/lidar-perception", "run", node],
}
LIMIT = 120.0  # seconds for a process to reach a stage, on a busy machine
NOTE = "std_msgs/msg/String"

pytestmark = pytest.mark.skipif(
    not (Path("/proc/self/maps").is_file() and STARTED_BY["ros2 run"]("tracker")[0].is_file()),
    reason="needs /proc, and the package installed by pip",
)


def blocks_signals(thread: Path) -> bool:
    """Return True if a thread blocks all signals that end a node."""
    blocked = int(re.search(r"^SigBlk:\s*(\w+)", (thread / "status").read_text(), re.M)[1], 16)
    return all(blocked >> (number - 1) & 1 for number in STOP_SIGNALS)


def find_shared_segments(process: Path) -> set[Path]:
    """Return the Fast DDS segments that a process created; it keeps their lock files open."""
    opened = {file.readlink() for file in (process / "fd").iterdir() if file.is_symlink()}
    return {
        path.with_name(path.name.removesuffix("_el"))
        for path in opened
        if re.fullmatch(r"fastrtps_[0-9a-f]{16}_el", path.name)
    }


def wait_for_stage(process: subprocess.Popen, stage: str, log: Path) -> None:
    """Wait until a starting node blocks signals, has loaded a library, or has logged a word."""
    proc, end = Path(f"/proc/{process.pid}"), monotonic() + LIMIT
    own = Path("/proc/self/cmdline").read_bytes()
    # Between fork and exec the child still has this process's libraries and blocks all signals,
    # and the shell of the start script blocks them for a moment whenever it runs a command.
    while (proc / "cmdline").read_bytes().startswith((own, b"/bin/sh")) or not (
        blocks_signals(proc) if stage == "blocked" else stage in (proc / "maps").read_text() or stage in log.read_text()
    ):
        assert process.poll() is None and monotonic() < end, log.read_text()
        sleep(0.01)


def start_process(processes, how: str, node: str, *arguments: str) -> tuple[subprocess.Popen, Path]:
    processes.run(node, [*map(str, STARTED_BY[how](node)), *arguments])
    return processes.running[node], processes.logs / f"{node}.log"


@pytest.mark.parametrize(
    "how, node, stage, number",
    [
        ("ros2 run", "clustering", "blocked", signal.SIGINT),
        ("ros2 run", "perception", "numpy", signal.SIGTERM),
        ("ros2 run", "fused_detector", "configuring", signal.SIGINT),
        ("lidar-perception run", "tracker", "blocked", signal.SIGTERM),
        ("lidar-perception run", "evaluator", "ready", signal.SIGINT),
    ],
)
def test_node_stops_cleanly_at_any_stage(how, node, stage, number, processes):
    process, log = start_process(processes, how, node)
    wait_for_stage(process, stage, log)
    proc = Path(f"/proc/{process.pid}")
    if stage == "ready":
        assert all(map(blocks_signals, (proc / "task").iterdir()))
    segments = find_shared_segments(proc)
    assert segments or stage not in ("configuring", "ready")  # DDS has started by then
    process.send_signal(number)
    assert process.wait(timeout=60) == 0
    assert not [path for path in segments if path.exists()] and "Traceback" not in log.read_text()


@pytest.mark.parametrize("command", ["basename", "dirname", "env"])
def test_start_script_stops_at_signal_during_command(command, tmp_path):
    """Send a signal from a command of the script to the whole process group, as a terminal does at Ctrl-C."""
    script, python, program = tmp_path / "lib/lidar_perception/tracker", tmp_path / "bin/python3", tmp_path / command
    signalled = tmp_path / "signalled"
    for path, text in (
        (script, STARTED_BY["ros2 run"]("tracker")[0].read_text()),
        (python, f"#!{sys.executable}\nimport signal\nraise SystemExit(not signal.sigpending())\n"),
        (program, f'#!/bin/sh\n: > "{signalled}"\nkill -INT 0\n'),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        path.chmod(0o755)
    code = subprocess.call(
        ["/usr/bin/env", "--default-signal=INT", script],  # a shell cannot trap a signal that is ignored at its start
        env={"PATH": f"{tmp_path}:/usr/bin:/bin"},
        start_new_session=True,
        stderr=subprocess.DEVNULL,
    )
    assert code == 0 or not signalled.exists()


@pytest.mark.parametrize("number", sorted(STOP_SIGNALS))
def test_recorder_completes_its_bag(number, processes, peer, tmp_path):
    bag, note = tmp_path / "bag", make_bag_message(NOTE)
    process, _ = start_process(
        processes, "ros2 run", "bag_recorder", "--ros-args", "-p", f"bag:={bag}", "-p", "topics:=[/note]"
    )
    peer.send(
        peer.advertise("/note", NOTE), note, lambda: int(peer.get_value("bag_recorder", "frames") or 0) > 1, "two notes"
    )
    process.send_signal(number)
    assert process.wait(timeout=60) == 0
    with Bag(bag) as reader:
        assert reader.counts["/note"] > 1
    assert [path.name for path in tmp_path.glob("bag*")] == ["bag"]


def test_node_entry_blocks_signals_before_loading_libraries():
    """Threads of libraries, such as NumPy's OpenBLAS, would otherwise not block them."""
    code = (
        "import sys; before = {*sys.modules}; import lidar_perception.nodes.main, "
        "lidar_perception.cli.entry; print(*{n.partition('.')[0] for n in {*sys.modules} - "
        "before} - sys.stdlib_module_names)"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).split() == ["lidar_perception"]

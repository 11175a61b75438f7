"""A node's process ends at a signal with code 0, whatever holds the interpreter's lock."""

import signal
import subprocess
import sys

import pytest

PROGRAM = """
import ctypes, os, signal, sys
from lidar_perception.nodes.main import STOP_SIGNALS
signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
from lidar_perception.nodes.stopping import Stop
import threading
stop, awake = Stop(STOP_SIGNALS), threading.Event()
stop.react = awake.set
hang = lambda: ctypes.PyDLL(None).sleep(60)  # a call that keeps the interpreter's lock
print("ready", flush=True)
{rest}
"""
WORK_HANGS = "hang()"
TEARDOWN_HANGS = "awake.wait(); stop.closing(); stop.closed(3); hang()"
WRITES_LONG = ("from time import sleep\nawake.wait(); stop.closing(); sleep(7)\n"
               "print('written', flush=True); stop.closed(0)")
ENDS_BY_ITSELF = "stop.closing(); stop.closed(2); hang()"


CASES = {"work": (WORK_HANGS, 0, ""), "teardown": (TEARDOWN_HANGS, 3, ""),
         "writing": (WRITES_LONG, 0, "written\n"), "by itself": (ENDS_BY_ITSELF, 2, "")}
NUMBERS = (signal.SIGINT, signal.SIGTERM)


@pytest.fixture(scope="module")
def ended():
    """(case, signal) -> exit code and what it wrote; all at once, as some take seconds."""
    running = {(name, number): subprocess.Popen([sys.executable, "-c", PROGRAM.format(rest=rest)],
                                                text=True, stdout=subprocess.PIPE)
               for name, (rest, _, _) in CASES.items() for number in NUMBERS}
    for (name, number), process in running.items():
        assert process.stdout.readline() == "ready\n"
        if name != "by itself":
            process.send_signal(number)
    return {key: (process.communicate(timeout=30)[0], process.returncode)
            for key, process in running.items()}


@pytest.mark.parametrize("name", list(CASES))
@pytest.mark.parametrize("number", NUMBERS)
def test_ends_whatever_hangs(ended, name, number):
    _, code, output = CASES[name]
    assert ended[name, number] == (output, code)


@pytest.mark.parametrize("number", NUMBERS)
def test_run_ends_its_node_cleanly(number, processes, peer):
    pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")
    command = [sys.executable, "-m", "lidar_perception.cli.main", "run", "evaluator"]
    processes.run("evaluator", command)
    peer.wait_for_diagnostics("evaluator")
    node = processes.running["evaluator"]
    node.send_signal(number)
    assert node.wait(timeout=20) == 0

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


# What hangs, the signal that comes then, the exit code and what is written. Of the signals none is
# special (STOP_SIGNALS), so each case has one.
CASES = {"work": (WORK_HANGS, signal.SIGINT, 0, ""),
         "teardown": (TEARDOWN_HANGS, signal.SIGTERM, 3, ""),
         "writing": (WRITES_LONG, signal.SIGTERM, 0, "written\n"),
         "by itself": (ENDS_BY_ITSELF, None, 2, "")}


@pytest.fixture(scope="module")
def ended():
    """case -> what it wrote and its exit code; all at once, as some take seconds."""
    running = {name: subprocess.Popen([sys.executable, "-c", PROGRAM.format(rest=rest)],
                                      text=True, stdout=subprocess.PIPE)
               for name, (rest, *_) in CASES.items()}
    for name, process in running.items():
        assert process.stdout.readline() == "ready\n"
        if CASES[name][1]:
            process.send_signal(CASES[name][1])
    return {name: (process.communicate(timeout=30)[0], process.returncode)
            for name, process in running.items()}


@pytest.mark.parametrize("name", list(CASES))
def test_ends_whatever_hangs(ended, name):
    _, _, code, output = CASES[name]
    assert ended[name] == (output, code)


@pytest.mark.parametrize("number", (signal.SIGINT, signal.SIGTERM))
def test_run_ends_its_node_cleanly(number, processes, peer):
    pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")
    command = [sys.executable, "-m", "lidar_perception.cli.main", "run", "evaluator"]
    processes.run("evaluator", command)
    peer.wait_for_diagnostics("evaluator")
    node = processes.running["evaluator"]
    node.send_signal(number)
    assert node.wait(timeout=20) == 0

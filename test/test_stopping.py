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


@pytest.mark.parametrize("rest, code, output", [
    (WORK_HANGS, 0, ""), (TEARDOWN_HANGS, 3, ""), (WRITES_LONG, 0, "written\n"),
    (ENDS_BY_ITSELF, 2, "")])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ends_whatever_hangs(rest, code, output, number):
    with subprocess.Popen([sys.executable, "-c", PROGRAM.format(rest=rest)], text=True,
                          stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == "ready\n"
        if rest != ENDS_BY_ITSELF:
            process.send_signal(number)
        assert process.stdout.read() == output
        assert process.wait(timeout=20) == code

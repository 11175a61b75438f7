"""A node exits with 0 at a signal, even if a library holds the interpreter lock."""

import importlib.util
import signal
import subprocess
import sys
from types import SimpleNamespace

import pytest

PROGRAM = """
import ctypes, os, signal, sys
from lidar_perception.nodes.main import STOP_SIGNALS
signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
from lidar_perception.nodes.stopping import Stop
import threading
stop, awake = Stop(STOP_SIGNALS), threading.Event()
stop.on_signal = awake.set
hang = lambda: ctypes.PyDLL(None).sleep(60)  # a call that keeps the interpreter's lock
print("ready", flush=True)
{rest}
"""
WORK_HANGS = "hang()"
TEARDOWN_HANGS = "awake.wait(); stop.begin_closing(); stop.finish_closing(3); hang()"
WRITES_LONG = (
    "from time import sleep\nawake.wait(); stop.begin_closing(); sleep(7)\n"
    "print('written', flush=True); stop.finish_closing(0)"
)
ENDS_BY_ITSELF = "stop.begin_closing(); stop.finish_closing(2); hang()"
REFUSED = """
from lidar_perception.nodes.main import _run_nodes
from lidar_perception.types import InputError
class Made:
    __del__ = lambda self: hang()
class Refused:
    def __init__(self):
        self.made = Made()  # as a node with invalid parameters does
        raise InputError("refused")
sys.exit(_run_nodes([(Refused, ["node"], {})], ["node"], 0.0, stop))
"""


# Each case: rest of the program, signal, exit code and output. All STOP_SIGNALS are equivalent, so each case has one.
CASES = {
    "work": (WORK_HANGS, signal.SIGINT, 0, ""),
    "teardown": (TEARDOWN_HANGS, signal.SIGTERM, 3, ""),
    "writing": (WRITES_LONG, signal.SIGTERM, 0, "written\n"),
    "by itself": (ENDS_BY_ITSELF, None, 2, ""),
}
if importlib.util.find_spec("rclpy"):
    CASES["what a refused node has made"] = REFUSED, None, 2, ""


@pytest.fixture(scope="module")
def finished_cases():
    """Run all cases at the same time; return {case: (output, exit code)}."""
    running = {
        name: subprocess.Popen([sys.executable, "-c", PROGRAM.format(rest=rest)], text=True, stdout=subprocess.PIPE)
        for name, (rest, *_) in CASES.items()
    }
    for name, process in running.items():
        assert process.stdout.readline() == "ready\n"
        if CASES[name][1]:
            process.send_signal(CASES[name][1])
    return {name: (process.communicate(timeout=30)[0], process.returncode) for name, process in running.items()}


@pytest.mark.parametrize("name", list(CASES))
def test_node_ends_although_a_callback_hangs(finished_cases, name):
    _, _, code, output = CASES[name]
    assert finished_cases[name] == (output, code)


class ChangingGraph:
    """Node in whose graph other nodes keep leaving for some time, or forever."""

    def __init__(self, looks):
        self.looks, self.destroyed = looks, None

    def get_topic_names_and_types(self):
        return []

    def get_node_names_and_namespaces(self):
        self.looks -= 1
        return [(f"node_{max(self.looks, 0)}", "/")]

    def destroy_node(self):
        self.destroyed = self.looks


@pytest.mark.parametrize("looks", [3, 10**9])
def test_context_shuts_down_after_the_graph_is_stable(looks, monkeypatch):
    pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")
    from lidar_perception.nodes import external_node
    from lidar_perception.nodes.external_node import MAX_SETTLE_S, SETTLE_S, shut_down_context

    clock, ended = [0.0], []
    monkeypatch.setattr(external_node, "monotonic", lambda: clock[0])
    monkeypatch.setattr(external_node, "sleep", lambda s: clock.__setitem__(0, clock[0] + s))
    context, node = SimpleNamespace(try_shutdown=lambda: ended.append(clock[0])), ChangingGraph(looks)
    shut_down_context(context, node)
    if looks == 3:
        assert node.destroyed < 0 and SETTLE_S < ended[0] < 2 * SETTLE_S
    else:
        assert MAX_SETTLE_S <= ended[0] < MAX_SETTLE_S + SETTLE_S
    assert node.destroyed is not None

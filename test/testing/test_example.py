"""The files of docs/how-to/test-your-stack.md are written to a folder and its commands run there."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILES = re.findall(
    r"`(\w+\.py)`[^`]*?:?\n(?:[^`]*\n)?\n?```python\n(.*?)```",
    (ROOT / "docs/how-to/test-your-stack.md").read_text(),
    re.S,
)

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

BROKEN = """
import sys

def test_who_dies(peer, processes):
    processes.run("speaker", [sys.executable, "-c", "print('I am tired'); raise SystemExit(3)"])
    peer.wait(lambda: False, "a miracle")

def test_who_waits(peer):
    peer.wait_for_messages("/nowhere", "std_msgs/msg/Bool", count=2, timeout=0.1)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("stack")
    for name, text in FILES:
        (folder / name).write_text(text)
    return folder


def run(folder: Path, *command: str) -> subprocess.CompletedProcess:
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]),
    }
    return subprocess.run([sys.executable, "-m", *command], cwd=folder, env=environment, capture_output=True, text=True)


def test_page_contains_the_example_files():
    assert [name for name, _ in FILES] == [
        "emergency_stop.py",
        "conftest.py",
        "test_emergency_stop.py",
        "test_stop_launch.py",
    ]


def test_example_test_passes_and_failure_shows_the_detections(folder):
    (folder / "test_broken.py").write_text(BROKEN)
    done = run(folder, "pytest", "-q", "-p", "no:cacheprovider", "test_emergency_stop.py", "test_broken.py")
    output = " ".join(done.stdout.split())
    assert "2 failed, 3 passed" in output, done.stdout
    for words in (
        "while the test waited for a miracle, speaker ended with code 3",
        "log of speaker, which ended with code 3",
        "I am tired",
        "waiting for 2 messages on /nowhere; diagnostics: none; received: /nowhere no messages from 0 publishers",
    ):
        assert words in output, done.stdout


@pytest.mark.skipif(
    importlib.util.find_spec("launch_testing") is None, reason="needs launch_testing, which comes with ROS 2"
)
def test_launch_test_passes(folder):
    done = run(folder, "launch_testing.launch_test", "test_stop_launch.py")
    assert done.returncode == 0, done.stdout + done.stderr

"""Run the tests of this checkout: ./lidar test [ARGUMENTS of pytest].

Without arguments, runs ruff (rules and format), mypy, the build of the documentation site and all
tests. The tests of the core run on all cores, and two more processes run the tests that mostly wait
for other processes. Numba compiles once before the tests, while ruff and mypy run. Coverage must
reach the limit in setup.cfg. It is not measured in nodes that run in their own processes, nor in
long tests of lines that other tests cover, because it doubles their time.

    ./lidar test
    ./lidar test -k clustering -x
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from rich.text import Text

from lidar_perception.runs.terminal import errors
from lidar_perception.runs.threads import default_to_one_thread, use_passive_waiting

ROOT = Path(__file__).resolve().parents[1]
MAX_WORKERS = 4  # each worker needs memory for torch and compiled code
NODE_WORKERS = 2  # workers for tests that mostly wait for other processes
# Folders and files of tests that mostly wait for other processes, the slowest first.
NODE_TESTS = (
    "test/testing",
    "test/fuzz",
    "test/studio/test_label_server.py",
    "test/studio/test_page.py",
    "test/studio/test_page_saves.py",
    "test/launch",
    "test/ros",
)
# Programs that fill Numba's cache for the test processes.
COMPILE_PROGRAMS = (
    """
from lidar_perception.candidates.warm_up import warm_up
warm_up()
""",
    """
from lidar_perception.simulation.recording import simulate_frames
next(iter(simulate_frames(1, 1))).load()
""",
    """
from lidar_perception.detectors.open import LOAD, open_detector
from lidar_perception.simulation.recording import simulate_frames
for frame in simulate_frames(1, 1):
    for name in LOAD:
        open_detector(name)(frame.load())
""",
)


def main(arguments: list[str]) -> int:
    """Run everything, or only pytest if there are arguments. Return the exit code."""
    use_passive_waiting()
    if arguments:
        return subprocess.run([sys.executable, "-m", "pytest", *arguments], cwd=ROOT).returncode
    with tempfile.TemporaryDirectory() as folder:
        failures = run_everything(Path(folder))
    if failures:
        errors.print(Text("failed:", "red") + f" {', '.join(failures)}")
    return int(bool(failures))


class BackgroundCommand:
    """A Python command that runs in the background. wait() prints its output."""

    def __init__(self, *words: str, environment: dict[str, str] | None = None):
        self.output = tempfile.TemporaryFile("w+")
        self.process = subprocess.Popen(
            [sys.executable, *words], cwd=ROOT, env=environment, stdout=self.output, stderr=subprocess.STDOUT
        )

    def wait(self) -> bool:
        """Wait for the end of the command and print its output. Return True if it failed."""
        code = self.process.wait()
        self.output.seek(0)
        print(self.output.read(), end="", flush=True)
        return bool(code)


def run_everything(folder: Path) -> list[str]:
    """Run all checks and tests, and return the names of those that failed.

    Args:
        folder: Folder for coverage files and the built site.
    """
    default_to_one_thread()  # because there are as many processes as cores
    environment = {**os.environ, "COVERAGE_FILE": str(folder / "coverage")}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # so that each module is compiled once
    if sys.version_info >= (3, 12):
        environment["COVERAGE_CORE"] = "sysmon"  # measures each line only the first time that it runs
    pytest = ("-m", "pytest", "--cov", "--cov-report=", "--cov-fail-under=0")
    node_tests = [name for name in NODE_TESTS if (ROOT / name).exists()]
    workers = min(os.cpu_count() or 1, MAX_WORKERS)
    commands = {
        "ruff": BackgroundCommand("-m", "ruff", "check"),
        "formatter": BackgroundCommand("-m", "ruff", "format", "--check"),
        "mypy": BackgroundCommand("-m", "mypy"),
    }
    *first_programs, last_program = COMPILE_PROGRAMS  # failures are ignored, because the tests then fail too
    for command in [BackgroundCommand("-c", program) for program in first_programs]:
        command.wait()
    BackgroundCommand("-c", last_program).wait()
    commands["docs"] = BackgroundCommand(
        "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder / "site")
    )
    commands["tests of nodes"] = BackgroundCommand(
        *pytest,
        *_make_worker_options(NODE_WORKERS),
        *node_tests,
        environment={**environment, "COVERAGE_FILE": str(folder / "nodes")},
    )
    core_tests = subprocess.run(
        [sys.executable, *pytest, *_make_worker_options(workers), *(f"--ignore={name}" for name in node_tests)],
        cwd=ROOT,
        env=environment,
    )
    failures = ["tests"] * bool(core_tests.returncode)
    failures += [name for name, command in commands.items() if command.wait()]
    coverage, environment["COVERAGE_FILE"] = [sys.executable, "-m", "coverage"], str(folder / "all")
    subprocess.run(
        [*coverage, "combine", "--quiet", "--keep", str(folder / "coverage"), str(folder / "nodes")],
        cwd=ROOT,
        env=environment,
    )
    coverage_report = subprocess.run([*coverage, "report"], cwd=ROOT, env=environment)
    return [*failures, *["coverage"] * bool(coverage_report.returncode)]


def _make_worker_options(workers: int) -> tuple[str, ...]:
    """Return the options of pytest for this many processes.

    Each worker gets complete files, in the given order. By default pytest-xdist sorts files by their
    number of tests, so that the slowest ones would come last.
    """
    return "-n", str(workers), "--dist", "loadfile", "--no-loadscope-reorder"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

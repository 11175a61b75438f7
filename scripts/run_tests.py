"""Run the tests of this checkout: ./lidar test [ARGUMENTS of pytest].

Without arguments: ruff (rules and format), mypy, the documentation site and all tests. The tests of the core run on
all cores, and two more processes run the tests that mostly wait for other processes. Numba compiles
once before the tests, while ruff and mypy run. Coverage must reach the limit in setup.cfg. It is
not measured in nodes with their own processes, nor in long tests of lines that others cover, as
this doubles their time.

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
MAX_WORKERS = 4  # each loads torch and compiles
NODE_WORKERS = 2  # for tests that mostly wait
# Folders and files of these tests, the slowest first.
WITH_PROCESSES = (
    "test/testing",
    "test/fuzz",
    "test/studio/test_label_server.py",
    "test/studio/test_page.py",
    "test/studio/test_page_saves.py",
    "test/launch",
    "test/ros",
)
# Programs that fill Numba's cache, from which the test processes load.
COMPILE = (
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
    """Run everything, or pytest alone with the arguments; return the exit code."""
    use_passive_waiting()
    if arguments:
        return subprocess.run([sys.executable, "-m", "pytest", *arguments], cwd=ROOT).returncode
    with tempfile.TemporaryDirectory() as folder:
        failed = run_everything(Path(folder))
    if failed:
        errors.print(Text("failed:", "red") + f" {', '.join(failed)}")
    return int(bool(failed))


class BackgroundCommand:
    """A Python command in the background; its output is printed when it has ended."""

    def __init__(self, *words: str, environment: dict[str, str] | None = None):
        self.output = tempfile.TemporaryFile("w+")
        self.process = subprocess.Popen(
            [sys.executable, *words], cwd=ROOT, env=environment, stdout=self.output, stderr=subprocess.STDOUT
        )

    def failed(self) -> bool:
        """Wait for the end; return True if the command failed."""
        code = self.process.wait()
        self.output.seek(0)
        print(self.output.read(), end="", flush=True)
        return bool(code)


def run_everything(folder: Path) -> list[str]:
    """Run all checks and tests, and return the names of those that failed.

    folder: for the files of the coverage measurement.
    """
    default_to_one_thread()  # as many processes as cores
    environment = {**os.environ, "COVERAGE_FILE": str(folder / "coverage")}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # so that each module is compiled once
    if sys.version_info >= (3, 12):
        environment["COVERAGE_CORE"] = "sysmon"  # each line costs time only once
    pytest = ("-m", "pytest", "--cov", "--cov-report=", "--cov-fail-under=0")
    nodes = [name for name in WITH_PROCESSES if (ROOT / name).exists()]
    workers = min(os.cpu_count() or 1, MAX_WORKERS)
    running = {
        "ruff": BackgroundCommand("-m", "ruff", "check"),
        "formatter": BackgroundCommand("-m", "ruff", "format", "--check"),
        "mypy": BackgroundCommand("-m", "mypy"),
    }
    *parts, last = COMPILE  # if they fail, so do the tests
    for compiling in [BackgroundCommand("-c", part) for part in parts]:
        compiling.failed()
    BackgroundCommand("-c", last).failed()
    running["docs"] = BackgroundCommand(
        "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder / "site")
    )
    running["tests of nodes"] = BackgroundCommand(
        *pytest,
        *_distributed(NODE_WORKERS),
        *nodes,
        environment={**environment, "COVERAGE_FILE": str(folder / "nodes")},
    )
    core = subprocess.run(
        [sys.executable, *pytest, *_distributed(workers), *(f"--ignore={name}" for name in nodes)],
        cwd=ROOT,
        env=environment,
    )
    failed = ["tests"] * bool(core.returncode)
    failed += [name for name, command in running.items() if command.failed()]
    coverage, environment["COVERAGE_FILE"] = [sys.executable, "-m", "coverage"], str(folder / "all")
    subprocess.run(
        [*coverage, "combine", "--quiet", "--keep", str(folder / "coverage"), str(folder / "nodes")],
        cwd=ROOT,
        env=environment,
    )
    coverage_report = subprocess.run([*coverage, "report"], cwd=ROOT, env=environment)
    return [*failed, *["coverage"] * bool(coverage_report.returncode)]


def _distributed(workers: int) -> tuple[str, ...]:
    """Return the options of pytest for this many processes.

    Whole files are distributed in their order. pytest-xdist would sort them by their number of
    tests, and the slowest would come last.
    """
    return "-n", str(workers), "--dist", "loadfile", "--no-loadscope-reorder"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""Processes that are killed or stopped, disks that are full or read-only, work that is resumed."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from time import monotonic, sleep

from lidar_perception.campaign.case import FAILED, REFUSED, SKIPPED, SURVIVED, Case, Outcome
from lidar_perception.campaign.command import load_all, run_command
from lidar_perception.campaign.graph import LazyGraph, graph_nodes
from lidar_perception.types import InputError

SECONDS, MEGABYTES = 240.0, 4000.0
STOPPED = 4.0  # seconds, longer than the diagnostics take to notice
SENSOR = "generic:16,-24,4,0.8,10"
TRAIN = ("train", "pointnet", "--data", "sim", "--sensor", SENSOR, "--data-scans", "2",
         "--data-val-scans", "1", "--data-people", "1", "--steps", "6", "--validate-steps", "2",
         "--log-steps", "1", "--batch", "1", "--jobs", "0", "--device", "cpu")
# What is stopped in the middle -> the command, what is added to resume it, and the files that must
# be the same afterwards, byte by byte; the paper's Table 9 is about times.
WORK: dict[str, tuple[tuple[str, ...], tuple[str, ...], str]] = {
    "convert": (("convert", "many"), (), "*.mcap"),
    "simulate": (("simulate", "--format", "kitti", "--sensor", SENSOR, "--frames", "12", "--jobs",
                  "1"), ("--resume",), "training/**/*"),
    "train": (TRAIN, ("--resume",), "last.safetensors"),
    "reproduce": (("reproduce", "stm-cpa", "--data", "many", "--jobs", "1"), (),
                  "tables/table_[!9]*.csv"),
}
MOMENTS = (0.3, 0.6, 0.9)  # shares of the time that the whole takes, from when it says something
# What writes, for disks that are full or read-only; {} is the place.
WRITERS = [("convert", "kitti", "--out", "{}/made"), ("convert", "many", "--out", "{}/made"),
           ("simulate", "--sensor", SENSOR, "--frames", "3", "--out", "{}/made"),
           ("simulate", "--format", "kitti", "--sensor", SENSOR, "--frames", "3", "--jobs", "1",
            "--out", "{}/made"),
           ("seed", "--data", "kitti", "--out", "{}/seed.json"),
           ("evaluate", "candidates", "--data", "kitti", "--json", "{}/scores.json"),
           ("evaluate", "candidates", "--data", "kitti", "--png", "{}/scores.png"),
           (*TRAIN, "--out", "{}/made"),
           ("reproduce", "stm-cpa", "--data", "kitti", "--jobs", "1", "--out", "{}/made")]
ROOM = (0, 4096, 20_000, 100_000)  # bytes
CASES = [*(("node", node, fault) for node, fault in product(
            graph_nodes(), ("SIGKILL", "SIGSTOP", "SIGINT"))),
         *(("full", i, room) for i, room in product(range(len(WRITERS)), ROOM)),
         *(("read-only", i, 0) for i in range(len(WRITERS))),
         *(("stopped", work, f"{name} {moment}") for moment, work, name in product(
             MOMENTS, WORK, ("SIGINT", "SIGKILL")))]


def case_of(seed: int, number: int) -> Case | None:
    """Every fault once, always in the same order: there is nothing to draw."""
    if number >= len(CASES):
        return None
    kind, what, how = CASES[number]
    return Case("faults", f"{kind}: {what} {how}", seed, number,
                {"kind": kind, "what": what, "how": how})


class Attempt:
    """A folder with data; a graph, while nodes are the matter."""

    def __init__(self, folder: Path):
        self.folder = folder
        subprocess.run([sys.executable, "-m", "lidar_perception.campaign.samples", "write_samples",
                        str(folder)],
                       check=True)
        for i in range(40):  # as many frames as take a while
            for part, ending in (("velodyne", "bin"), ("calib", "txt"), ("label_2", "txt")):
                target = folder / f"many/training/{part}/{i:06}.{ending}"
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(folder / f"kitti/training/{part}/{i % 2:06}.{ending}", target)
        os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
        load_all()
        self.graph = LazyGraph(folder)
        self.wholes: dict[str, tuple[float, dict[str, bytes]]] = {}

    def __call__(self, case: Case) -> Outcome:
        kind, what, how = (case.settings[key] for key in ("kind", "what", "how"))
        if kind == "node":
            return self._node(what, signal.Signals[how])
        self.close()
        if kind == "stopped":
            name, moment = how.split()
            return self._stopped(what, signal.Signals[name], float(moment))
        return self._no_room(WRITERS[what], how, read_only=kind == "read-only")

    def close(self) -> None:
        """End the nodes."""
        self.graph.close()

    def _node(self, name: str, fault: signal.Signals) -> Outcome:
        """The others live on, and all serve a good cloud once the node is there again."""
        graph = self.graph()
        process = graph.processes.running[name]
        process.send_signal(fault)
        try:
            if fault == signal.SIGSTOP:
                graph.spin(STOPPED)
                process.send_signal(signal.SIGCONT)
            else:
                code = process.wait(30.0)
                if code not in (0, -signal.SIGKILL):
                    return Outcome(FAILED, f"{name} ended with code {code} at {fault.name}")
                del graph.processes.running[name]
                shutil.rmtree(graph.folder / "recorded", ignore_errors=True)
                graph.processes.check()  # the others
                graph.start(name)
            graph.alive()
        except (InputError, subprocess.TimeoutExpired) as error:
            self.close()
            return Outcome(FAILED, f"{name}, {fault.name}: {error}")
        return Outcome(SURVIVED)

    def _no_room(self, writer: tuple[str, ...], room: int, read_only: bool) -> Outcome:
        """One line and no traceback; what finds room is a result."""
        place = self.folder / "place"
        with _disk(place, room, read_only) as mounted:
            if read_only and not mounted:
                return Outcome(SKIPPED, "a read-only folder needs the right to mount")
            said = run_command([word.format(place) for word in writer], self.folder, SECONDS,
                               None if mounted else max(1, room))
            outcome = said.outcome(MEGABYTES)
        if read_only and outcome.verdict == SURVIVED:
            return Outcome(FAILED, "exit code 0, and nothing can have been written")
        return outcome

    def _stopped(self, work: str, fault: signal.Signals, moment: float) -> Outcome:
        """The same files as of a run that nothing has stopped."""
        command, resume, pattern = WORK[work]
        if work not in self.wholes:
            (self.folder / f"whole {work}").mkdir(exist_ok=True)
            begin, code = monotonic(), _run(self.folder, command, f"whole {work}/made")
            if code:
                return Outcome(FAILED, f"{work}: exit code {code} without any fault")
            self.wholes[work] = monotonic() - begin, _files(
                self.folder / f"whole {work}/made", pattern)
        seconds, wanted = self.wholes[work]
        out = f"stopped {work}/made"
        shutil.rmtree(self.folder / f"stopped {work}", ignore_errors=True)
        (self.folder / f"stopped {work}").mkdir()
        code = _run(self.folder, command, out, fault, moment * seconds)
        if fault == signal.SIGINT and code not in (
                0, 1, 2, 130, -signal.SIGINT):  # the last two are the same to a shell
            return Outcome(FAILED, f"{work}: exit code {code} after SIGINT: {_said(self.folder)}")
        if "Traceback" in (self.folder / "said").read_text(errors="replace"):
            return Outcome(FAILED, f"{work}: traceback after {fault.name}: {_said(self.folder)}")
        there = (self.folder / out).exists()
        # A bag is whole once it has its name, also if the signal comes between that and the end.
        ended = (code == 0 or work == "convert") and _files(self.folder / out, pattern) == wanted
        if not ended:
            code = _run(self.folder, (*command, *(resume if there else ())), out)
            if code:
                return Outcome(FAILED, f"{work}: exit code {code} when resumed after {fault.name}: "
                               f"{_said(self.folder)}")
        found = _files(self.folder / out, pattern)
        if found != wanted:
            names = sorted(n for n in found.keys() | wanted if found.get(n) != wanted.get(n))
            return Outcome(FAILED, f"{work}: after {fault.name} and a second run {len(names)} "
                           f"files are others, such as {names[0]}")
        return Outcome(REFUSED if ended else SURVIVED, "had ended before" if ended else "")


def _run(folder: Path, command: tuple[str, ...], out: str,
         fault: signal.Signals | None = None, after: float = 0.0) -> int:
    with open(folder / "said", "wb") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "lidar_perception.cli.main", *command, "--out", out],
            cwd=folder, stdin=subprocess.DEVNULL, stdout=said, stderr=said)
        if fault is not None:
            end = monotonic() + after
            while process.poll() is None and monotonic() < end:
                sleep(0.01)
            process.send_signal(fault)
        try:
            return process.wait(SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            return 124


def _said(folder: Path) -> str:
    lines = (folder / "said").read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else "nothing said"


def _files(folder: Path, pattern: str) -> dict[str, bytes]:
    """Path -> content; of weights what follows the header, which says how long training took."""
    found = {path.relative_to(folder).as_posix(): path.read_bytes()
             for path in sorted(folder.glob(pattern)) if path.is_file()}
    return {name: data[8 + int.from_bytes(data[:8], "little"):]
            if name.endswith(".safetensors") else data for name, data in found.items()}


@contextmanager
def _disk(place: Path, room: int, read_only: bool) -> Iterator[bool]:
    """A disk of so many bytes at a place, or an empty one that cannot be written; False where that
    needs rights that we do not have."""
    place.mkdir(exist_ok=True)
    how = "ro" if read_only else f"size={max(room, 4096)}"
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", how, "none", str(place)],
                             capture_output=True).returncode == 0
    if mounted and not read_only and room < 4096:
        (place / "full").write_bytes(bytes(4096))
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(place)], check=True)
        shutil.rmtree(place, ignore_errors=True)

"""The whole campaign: every part gets its share of the time, every failure a file that replays it.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any

from lidar_perception.campaign.case import FAILED, SKIPPED, Case, Outcome
from lidar_perception.campaign.worker import Limits, Worker
from lidar_perception.nodes import require_rclpy
from lidar_perception.runs.files import make_folder
from lidar_perception.runs.resuming import locked
from lidar_perception.types import InputError

# Part -> its share of the time, what one case may take, and what is tried.
PARTS: dict[str, tuple[float, Limits, str]] = {
    "messages": (5, Limits(120, 1500), "mutated messages through every node's callbacks"),
    "live": (2, Limits(300, 0), "mutated messages through the running graph, over DDS"),
    "shapes": (3, Limits(300, 6000), "adversarial clouds through every stage and network"),
    "files": (4, Limits(180, 0), "damaged bags, data sets, weights, templates, YAML"),
    "faults": (2, Limits(900, 0), "signals, killed and stopped nodes, full disks, resumed work"),
    "load": (1, Limits(2700, 0), "120,000 points at 10, 20 and 40 Hz"),
    "leaks": (3, Limits(3600, 0), "the same frames again and again through all that runs"),
}
NEEDS_ROS = {"messages", "live", "faults", "load", "leaks"}
FOREVER = 2**62
INTERRUPTED = "interrupted"  # by ctrl-C or SIGTERM
SAME = 5  # files that are kept of failures that give the same reason


@dataclass
class Tally:
    """What came of the cases of one part. reasons: (verdict, reason without its numbers) -> count;
    figures: case -> what was measured."""

    part: str
    tried: int = 0
    verdicts: Counter[str] = field(default_factory=Counter)
    reasons: Counter[tuple[str, str]] = field(default_factory=Counter)
    files: list[Path] = field(default_factory=list)
    figures: dict[str, dict[str, float]] = field(default_factory=dict)
    slowest: float = 0.0
    largest: float = 0.0
    seconds: float = 0.0
    problem: str = ""

    def add(self, outcome: Outcome) -> None:
        """Count one case."""
        self.tried += outcome.verdict != SKIPPED
        self.verdicts[outcome.verdict] += 1
        if outcome.reason:
            self.reasons[outcome.verdict, kind_of(outcome.reason)] += 1
        self.slowest = max(self.slowest, outcome.seconds)
        self.largest = max(self.largest, outcome.megabytes)

    def failed(self) -> bool:
        """Whether anything did, or the part could not run at all."""
        return bool(self.verdicts[FAILED] or self.problem)

    def content(self) -> dict[str, Any]:
        """For JSON."""
        return {"tried": self.tried, **self.verdicts, "problem": self.problem,
                "seconds": round(self.seconds, 1), "slowest_case_s": round(self.slowest, 2),
                "largest_case_mb": round(self.largest), "figures": self.figures,
                "failures": [str(path) for path in self.files],
                "reasons": [[*key, count] for key, count in self.reasons.most_common(200)]}


def kind_of(reason: str) -> str:
    """A reason without what differs from case to case: numbers, paths, what is quoted."""
    line = reason.strip().splitlines()[0] if reason.strip() else ""
    line = re.sub(r"'[^']*'|\"[^\"]*\"", "'..'", line)
    line = re.sub(r"(/[^\s:,;'()]+)+", "PATH", line)
    return re.sub(r"-?\b\d[\d.,e+-]*\b|\bnan\b|-?\binf\b", "N", line)[:160]


def run_campaign(out: Path, minutes: float, seed: int, only: Sequence[str] = (),
                 most: int | None = None,
                 watch: Callable[[Tally, float], None] = lambda tally, share: None) -> list[Tally]:
    """Run the parts, or only some, for so many minutes altogether, with at most `most` cases each.

    What a part leaves of its time goes to those after it. watch(tally, share of its time) is called
    as they go. Failures lie in out/failures. InputError for a part that there is none of, where the
    folder cannot be written, and while another campaign writes into it.
    """
    for name in only:
        if name not in PARTS:
            raise InputError(f"there is no part '{name}'; the parts are {', '.join(PARTS)}")
    chosen = [name for name in PARTS if not only or name in only]
    end, tallies = monotonic() + 60.0 * minutes, []
    with locked(out):  # two at once would take each other's files for what the package did
        make_folder(out / "failures")
        for i, name in enumerate(chosen):
            weight = PARTS[name][0] / sum(PARTS[n][0] for n in chosen[i:])
            tally = Tally(name)
            tallies.append(tally)
            try:
                _run_part(tally, out, seed, weight * max(0.0, end - monotonic()), most, watch)
            except KeyboardInterrupt:  # what is known so far is said all the same
                tally.problem = INTERRUPTED
                break
    return tallies


def _run_part(tally: Tally, out: Path, seed: int, seconds: float, most: int | None,
              watch: Callable[[Tally, float], None]) -> None:
    begin = monotonic()
    watch(tally, 0.0)
    try:
        with _worker(tally.part, out) as worker:
            for number, outcome, case in worker.cases(
                    seed, 0, FOREVER if most is None else most, begin + seconds):
                tally.add(outcome)
                if outcome.figures:
                    tally.figures[outcome.reason or str(number)] = outcome.figures
                if case is not None and tally.reasons[FAILED, kind_of(outcome.reason)] <= SAME:
                    path = out / "failures" / f"{tally.part}-{seed}-{number}.json"
                    case.save(path, outcome)
                    tally.files.append(path)
                watch(tally, (monotonic() - begin) / max(seconds, 1e-9))
    except InputError as error:
        tally.problem = str(error)
    tally.seconds = monotonic() - begin
    watch(tally, 1.0)


def replay(path: Path, out: Path) -> tuple[Case, Outcome]:
    """Try the case of a file again; what the part prints goes to the terminal."""
    case = Case.load(path)
    if case.part not in PARTS:
        raise InputError(f"{path}: there is no part '{case.part}'; the parts are "
                         f"{', '.join(PARTS)}")
    make_folder(out)
    with _worker(case.part, out, quiet=False) as worker:
        return case, worker.attempt(case)


def _worker(part: str, out: Path, quiet: bool = True) -> Worker:
    """InputError where the part needs rclpy, which is not there."""
    if part in NEEDS_ROS:
        require_rclpy()
    return Worker(part, PARTS[part][1], out, quiet)

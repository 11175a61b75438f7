"""One fuzz case, its outcome, and the loop that runs cases."""

from __future__ import annotations

import faulthandler
import traceback
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple

import numpy as np

SURVIVED, REFUSED, FAILED = "survived", "refused", "failed"
CASE_SECONDS = 300.0  # time limit of a case in seconds; after it, the process prints all stacks and ends


class Case(NamedTuple):
    """One input: its name, and the settings from which it is generated."""

    name: str
    settings: tuple[Any, ...] = ()


class Outcome(NamedTuple):
    """Result of a case. reason: why it was rejected or failed."""

    verdict: str
    reason: str = ""


def make_generator(part: str, seed: int, number: int) -> np.random.Generator:
    """Return the random generator of one case, which is the same on every machine."""
    return np.random.default_rng([zlib.crc32(part.encode()), seed, number])


def pick(rng: np.random.Generator, choices: Any) -> Any:
    """Draw one element of a sequence. Unlike rng.choice, it keeps the type."""
    return choices[int(rng.integers(len(choices)))]


def run_cases(
    make_case: Callable[[int, int], Case],
    attempt: Callable[[Case], Outcome],
    seed: int,
    numbers: Iterable[int],
    max_mb: float,
    deadline: float,
) -> Iterator[tuple[int, Case, Outcome, float]]:
    """Yield number, case, outcome and megabytes of each case, until the monotonic time `deadline`.

    An exception is a failure, and so is a case that takes more than max_mb of memory. A
    hanging case ends the process.
    """
    for number in numbers:
        if monotonic() > deadline:
            return
        case = make_case(seed, number)
        before = read_memory_mb("VmRSS", reset=True)
        faulthandler.dump_traceback_later(CASE_SECONDS, exit=True)
        try:
            outcome = attempt(case)
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            outcome = Outcome(FAILED, f"{type(error).__name__}: {error} ({Path(last.filename).name}:{last.lineno})")
        finally:
            faulthandler.cancel_dump_traceback_later()
        used_mb = max(0.0, read_memory_mb("VmHWM") - before)
        if used_mb > max_mb and outcome.verdict != FAILED:
            outcome = Outcome(FAILED, f"took {used_mb:.0f} MB, more than {max_mb:g}")
        yield number, case, outcome, used_mb


def read_memory_mb(name: str, reset: bool = False) -> float:
    """Return the memory of this process in MB by its name in /proc: VmRSS is the current value, VmHWM the maximum
    since the last reset. 0 on systems without /proc."""
    try:
        if reset:
            with open("/proc/self/clear_refs", "w") as file:
                file.write("5")
        with open("/proc/self/status") as file:
            return next(int(line.split()[1]) / 1024 for line in file if line.startswith(name))
    except OSError:
        return 0.0

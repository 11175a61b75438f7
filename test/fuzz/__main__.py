"""Long fuzz runs, see fuzz/__init__.py."""

from __future__ import annotations

import importlib
import re
import sys
import tempfile
from collections import Counter
from pathlib import Path
from time import monotonic

import click

from fuzz.case import FAILED, REFUSED, SURVIVED, run_cases

PARTS = {"messages": 1500.0, "parameters": 1500.0, "files": 3000.0}  # memory limit of one case, in MB


@click.command(help=f"Run fuzz cases of PART: {', '.join(PARTS)}. Exit code 1 if a case failed.")
@click.argument("part", type=click.Choice(list(PARTS)))
@click.option("--minutes", type=click.FloatRange(0.01), default=20.0, show_default=True)
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True)
@click.option("--first", type=click.IntRange(0), default=0, help="Number of the first case.")
@click.option("--cases", type=click.IntRange(1), default=2**40, help="Cases at most.")
def main(part: str, minutes: float, seed: int, first: int, cases: int) -> None:
    """Print each kind of failure once, and a summary."""
    module = importlib.import_module(f"fuzz.{part}")
    begin, verdicts, kinds, largest = monotonic(), Counter[str](), Counter[str](), 0.0
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        attempt = module.Attempt(Path(folder))
        for number, case, outcome, used_mb in run_cases(
            module.make_case, attempt, seed, range(first, first + cases), PARTS[part], begin + 60 * minutes
        ):
            verdicts[outcome.verdict] += 1
            largest = max(largest, used_mb)
            if outcome.verdict == FAILED:
                kinds[classify_reason(outcome.reason)] += 1
                if kinds[classify_reason(outcome.reason)] == 1:
                    print(f"{part} --seed {seed} --first {number} --cases 1: {case.name}: {outcome.reason}", flush=True)
    print(
        f"{part}: "
        + ", ".join(f"{verdicts[v]:,} {v}" for v in (SURVIVED, REFUSED, FAILED))
        + f" in {monotonic() - begin:.0f} s; at most {largest:.0f} MB",
        flush=True,
    )
    for kind, times in kinds.most_common():
        print(f"  {times:,} x {kind}")
    sys.exit(verdicts[FAILED] > 0 or not verdicts)


def classify_reason(reason: str) -> str:
    """Return the first line of a reason without numbers, paths and quoted words."""
    return re.sub(r"'[^']*'|/\S+|-?\b\d[\w.+-]*|\bnan\b", "..", reason.partition("\n")[0])[:160]


if __name__ == "__main__":
    main()

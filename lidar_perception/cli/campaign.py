"""campaign: tries to break the package, and says what came of it."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import click
from rich.box import SIMPLE_HEAD
from rich.progress import TaskID
from rich.table import Table
from rich.text import Text

from lidar_perception.campaign.case import FAILED, REFUSED, SKIPPED, SURVIVED
from lidar_perception.campaign.run import INTERRUPTED, PARTS, Tally, replay, run_campaign
from lidar_perception.runs.files import write_text
from lidar_perception.runs.stopping import terminated_as_interrupted
from lidar_perception.runs.terminal import console, progress

WIDTH = max(map(len, PARTS))


@click.command(help="Try to break the package, and say what came of it: mutated messages, "
               "adversarial clouds, damaged files, killed processes, overload, leaks.\n\n"
               "The same seed gives the same cases, and --minutes how many of them. Each part "
               "runs in a process of its own with limits of time and memory. A case is survived "
               "(there is a result), refused with a reason, or failed. Each failure is kept as a "
               "file, which --replay tries again. Exit code 1 if anything failed.\n\n"
               "\b\nParts:\n" + "\n".join(f"  {name:{WIDTH}}  {what}"
                                          for name, (_, _, what) in PARTS.items()) + "\n\n"
               "\b\nExamples:\n"
               "  lidar-perception campaign --minutes 5\n"
               "  lidar-perception campaign --only messages --cases 100000 --minutes 60\n"
               "  lidar-perception campaign --replay out/campaign/failures/files-1-17.json")
@click.option("--minutes", type=click.FloatRange(0.01), default=20.0, show_default=True,
              help="Of all parts together. A part that has tried all of its cases leaves its time "
              "to the next; a case that has begun is tried to its end.")
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True,
              help="The same seed gives the same cases.")
@click.option("--only", type=click.Choice(list(PARTS)), multiple=True,
              help="Only this part; may be given several times.")
@click.option("--cases", type=click.IntRange(1), help="At most this many cases of each part.")
@click.option("--out", type=click.Path(path_type=Path), default=Path("out/campaign"),
              show_default=True, help="Folder for campaign.json, failures/ and the logs.")
@click.option("--replay", "file", type=click.Path(path_type=Path), metavar="FILE",
              help="Try the case of this file again; nothing else is done.")
def campaign(minutes: float, seed: int, only: tuple[str, ...], cases: int | None, out: Path,
             file: Path | None) -> None:
    if file is not None:
        with tempfile.TemporaryDirectory(prefix="campaign-") as folder:
            case, outcome = replay(file, Path(folder))
        console.print(f"{case.part}, {case.name}: {outcome.verdict}"
                      f"{f': {outcome.reason}' if outcome.reason else ''}")
        raise SystemExit(1 if outcome.verdict == FAILED else 0)
    with terminated_as_interrupted(), progress() as bar:
        tasks: dict[str, TaskID] = {}

        def watch(tally: Tally, share: float) -> None:
            if tally.part not in tasks:
                tasks[tally.part] = bar.add_task(tally.part, total=100)
            bar.update(tasks[tally.part], completed=min(100, int(100 * share)),
                       description=f"{tally.part:{WIDTH}} {tally.tried:,} tried, "
                       f"{tally.verdicts[FAILED]:,} failed")

        tallies = run_campaign(out, minutes, seed, only, cases, watch)
    write_text(out / "campaign.json", json.dumps(
        {"seed": seed, "minutes": minutes, **{t.part: t.content() for t in tallies}}, indent=1))
    _print(tallies)
    if any(t.problem == INTERRUPTED for t in tallies):
        raise SystemExit(130)
    raise SystemExit(1 if any(t.failed() for t in tallies) else 0)


def _print(tallies: list[Tally]) -> None:
    table = Table(box=SIMPLE_HEAD)
    for name in ("part", "tried", SURVIVED, REFUSED, FAILED, SKIPPED, "s", "slowest", "MB"):
        table.add_column(name, justify="left" if name == "part" else "right")
    for t in tallies:
        table.add_row(t.part, f"{t.tried:,}", *(f"{t.verdicts[v]:,}" for v in (
            SURVIVED, REFUSED, FAILED, SKIPPED)), f"{t.seconds:.0f}", f"{t.slowest:.1f} s",
            f"{t.largest:.0f}")
    console.print(table)
    for t in tallies:
        for name, figures in t.figures.items():
            console.print(f"{t.part}, {name}: " + ", ".join(
                f"{k} {v:g}" for k, v in figures.items()))
        if t.problem:
            console.print(t.problem, style="red")
        for (verdict, reason), count in t.reasons.most_common():
            if verdict in (FAILED, SKIPPED):
                console.print(Text(t.part, "red") + f" {verdict} {count:,} x: {reason}")
        for path in t.files:
            console.print(f"  lidar-perception campaign --replay {path}")

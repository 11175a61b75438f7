"""The folder of a run: what may be there when one begins, and that one alone writes there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lidar_perception.runs.files import check_folder, remove_temporaries
from lidar_perception.runs.resuming import locked
from lidar_perception.runs.stopping import terminated_as_interrupted
from lidar_perception.training.ranks import rank
from lidar_perception.types import InputError

RUN = "run.json"   # what was asked for, measured and planned at the first start
STATE = "last.pt"  # what a resumed run needs
WEIGHTS = "best.safetensors", "last.safetensors"
SCANS = "scans"    # the cache, unless another one is asked for
WRITTEN = (RUN, STATE, *WEIGHTS, "objects.npz", "log.csv", "validation.csv")


def may_begin(out: Path, resume: bool, name: str = STATE) -> Path:
    """The path in out of a file that a run writes. InputError if there is one, and resume is not
    asked for; or if out cannot be a folder that is written into, before hours are spent on the
    data."""
    path = out / name
    check_folder(out)
    if path.exists() and not resume:
        raise InputError(f"{out} holds a training run already; give --resume to resume it, or "
                         "another --out")
    return path


def may_hold(out: Path, resume: bool) -> None:
    """InputError as may_begin, and for weights in out that are of no run there: those of somebody
    else, or those that this one is to begin with. They would be replaced."""
    runs = [may_begin(out, resume, name).exists() for name in (RUN, STATE)]
    for name in WEIGHTS:
        if not any(runs) and (out / name).exists():
            raise InputError(f"{out / name} is of no run that could be resumed, and would be "
                             "replaced; give another --out")


@contextmanager
def alone(out: Path) -> Iterator[None]:
    """Keeps a second run from writing into out, removes what a killed one was writing, and ends at
    SIGTERM as at ctrl-C; in the first of the processes that train together."""
    if rank() > 0:
        yield
        return
    with locked(out), terminated_as_interrupted():
        remove_temporaries(out, *WRITTEN)
        for folder in (out / SCANS, *(out / SCANS).glob("*/")):
            remove_temporaries(folder, "*.npz")
        yield

"""The request for a training run, the same for every network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path("package")  # value of --init and --proposer for the weights that ship with it


@dataclass(frozen=True)
class TrainingRequest:
    """Data, output folder and limits of a training run.

    Attributes:
        data, val: Paths of recordings, or "sim", to train on and to validate on.
        split, val_split: Files that name the frames of data and of val to use.
        out: Folder of the run.
        resume: Continue the run in out, if there is one.
        init: Checkpoint to start from, or PACKAGE.
        device: "auto", "cpu" or a CUDA device.
        jobs: Processes that prepare scenes; 0 prepares them in this process.
        budget: Hours that the run may take. None: no limit if the number of steps is given,
            else planning.DEFAULT_BUDGET_H.
    """

    data: tuple[str, ...]
    val: tuple[str, ...]
    split: Path | None
    val_split: Path | None
    out: Path
    resume: bool
    init: Path | None
    device: str
    jobs: int
    budget: float | None = None

"""Request for a training run of any network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path("package")  # value of --init and --proposer that means the packaged weights


@dataclass(frozen=True)
class TrainingRequest:
    """Data, output folder and limits of a training run.

    Attributes:
        data, val: Paths of training and validation recordings, or "sim".
        split, val_split: Files with the names of the frames in data and val to use; None for all.
        out: Folder of the run.
        resume: Continue the run in out, if there is one.
        init: Checkpoint with initial weights, or PACKAGE; None for random weights.
        device: "auto", "cpu" or a CUDA device.
        jobs: Number of worker processes that prepare scenes; 0 prepares them in this process.
        budget: Time limit of the run in hours. None: planning.DEFAULT_BUDGET_H, or no limit if the
            number of steps is given.
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

"""What is asked of a training, whatever the network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Asked:
    """What to train and to validate on, where the run goes, and how many hours it may take; None:
    as long as the steps take, or start.BUDGET where it decides how many there are."""

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

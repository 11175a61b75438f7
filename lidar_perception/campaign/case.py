"""One case: what is tried, as a value that a file can hold, and what came of it."""

from __future__ import annotations

import base64
import json
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.runs.files import read_text, write_text
from lidar_perception.types import InputError

SURVIVED, REFUSED, FAILED, SKIPPED = "survived", "refused", "failed", "not tried"
MAX_BYTES = 2**30  # of a file that holds a case


@dataclass(frozen=True)
class Case:
    """What is tried: number `number` of a part under a seed. settings (values of JSON) and data are
    all that the part needs to try it again. seconds: how long it lasts at least; 0: not long."""

    part: str
    name: str
    seed: int
    number: int
    settings: dict[str, Any] = field(default_factory=dict)
    data: bytes = b""
    seconds: float = 0.0

    def save(self, path: Path, outcome: Outcome) -> None:
        """Write a file that `campaign --replay` takes."""
        write_text(path, json.dumps({
            "part": self.part, "name": self.name, "seed": self.seed, "number": self.number,
            "settings": self.settings, "data": base64.b64encode(self.data).decode(),
            "seconds": self.seconds, "reason": outcome.reason}, indent=1))

    @staticmethod
    def load(path: Path) -> Case:
        """The case of a file. InputError if it is none."""
        try:
            content = json.loads(read_text(path, MAX_BYTES))
            return Case(str(content["part"]), str(content["name"]), int(content["seed"]),
                        int(content["number"]), dict(content["settings"]),
                        base64.b64decode(content["data"]), float(content["seconds"]))
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{path} holds no case of a campaign ({type(error).__name__}: "
                             f"{error}); give a file from its folder failures/") from None


@dataclass(frozen=True)
class Outcome:
    """What came of a case. figures: what was measured, name -> number, for the table."""

    verdict: str
    reason: str = ""
    figures: dict[str, float] = field(default_factory=dict)
    seconds: float = 0.0
    megabytes: float = 0.0  # that it took at most, beyond what was held before


def generator(part: str, seed: int, number: int) -> np.random.Generator:
    """The random numbers of one case, the same on every machine."""
    return np.random.default_rng([zlib.crc32(part.encode()), seed, number])


def pick(rng: np.random.Generator, choices: Any) -> Any:
    """One of a sequence, as it is; rng.choice would make NumPy's types of it."""
    return choices[int(rng.integers(len(choices)))]

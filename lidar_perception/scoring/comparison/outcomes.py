"""All detectors of the package on the same frames.

They take turns: each frame begins with another one, so that whatever slows the machine, or warms
its caches, falls on all of them alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.kitti.folder import KittiFrame
from lidar_perception.data.recording import Recorded
from lidar_perception.scoring.kitti.protocol import DIFFICULTIES, SCORED
from lidar_perception.scoring.kitti.report import ROWS, DetectionReport
from lidar_perception.types import Detections, InputError

AP_ROWS = tuple(row for row, (metric, _) in ROWS.items() if metric != "image")


@dataclass(frozen=True)
class Contender:
    """A detector in the comparison.

    find(recorded): what it finds in a frame with labels and camera, boxes of low score too; None
    where a frame is none of its business. InputError where it cannot use the frame. classes: those
    that it knows. operating: score from which its pedestrians count as found when it is in use.
    source: its weights, empty without any.
    """

    name: str
    find: Callable[[Recorded], Detections | None]
    classes: tuple[str, ...] = SCORED
    operating: float = 0.3
    source: str = ""


@dataclass
class Outcome:
    """What a contender has found so far. failed: frames that it refused, with the reason; their
    objects count as missed."""

    contender: Contender
    report: DetectionReport = field(default_factory=DetectionReport)
    failed: list[str] = field(default_factory=list)

    def add(self, recorded: Recorded, calibration: Calibration) -> None:
        """Run on one frame."""
        found, begin = None, perf_counter()
        try:
            found = self.contender.find(recorded)
            if found is not None:
                self.report.ms.append((perf_counter() - begin) * 1e3)
        except InputError as error:
            self.failed.append(f"{recorded.name}: {error}")
        found = Detections.none() if found is None else found
        sound = np.isfinite(np.column_stack([found.boxes, found.scores])).all(axis=1)
        if not sound.all():
            self.failed.append(f"{recorded.name}: {(~sound).sum()} boxes are not finite")
        self.report.add(recorded.name, recorded.truth, found[sound], calibration)

    def content(self) -> dict:
        """As JSON: percent, ms, counts."""
        ap, centres = self.report.content()["ap"], self.report.pedestrians
        precision = {name: {row: {level: _r40(ap[name][row][level]) for level in DIFFICULTIES}
                            for row in AP_ROWS} if name in self.contender.classes else None
                     for name in ap}
        best = centres.best_score()
        scores = {"operating": self.contender.operating, "best": best}
        return {
            "weights": self.contender.source, "classes": list(self.contender.classes),
            "ap": precision, "mean_ap": {row: mean_moderate(precision, row) for row in AP_ROWS},
            "pedestrian_centres": {
                key: {"score": score, **centres.table(np.inf if score is None else score)["all"]}
                for key, score in scores.items()},
            "ms": float(np.median(self.report.ms)) if self.report.ms else None,
            "ms_of_frames": [round(ms, 3) for ms in self.report.ms],
            "frames": len(self.report.ms), "failed": self.failed}


def compare(frames: list[KittiFrame], outcomes: list[Outcome],
            skipped: list[str]) -> Iterator[None]:
    """Run every contender on every frame with labels; yields after each frame. Files that cannot be
    read go into skipped. The first frame is run once more before it counts, as a first run also
    loads what was compiled."""
    warm = False
    for i, frame in enumerate(frames):
        try:
            truth, calibration = frame.truth(), frame.calibration()
            recorded = None if truth is None else Recorded(frame.name, frame.load(), truth,
                                                           calibration.camera())
        except InputError as error:
            skipped.append(str(error))
            recorded = None
        if recorded is not None:
            if not warm:
                for outcome in outcomes:
                    with suppress(InputError):
                        outcome.contender.find(recorded)
                warm = True
            for outcome in in_turn(outcomes, i):
                outcome.add(recorded, calibration)
        yield


def in_turn(items: list, turn: int) -> list:
    """The items in their order, beginning with another one each turn."""
    begin = turn % max(len(items), 1)
    return items[begin:] + items[:begin]


def objects(outcome: Outcome) -> dict[str, dict[str, int]]:
    """How many labels there are to find, by class and difficulty; the same for all contenders."""
    return {name: {level: row["objects"] if (row := rows["3d"][level]) else 0
                   for level in DIFFICULTIES}
            for name, rows in outcome.report.content()["ap"].items()}


def mean_moderate(precision: dict[str, dict | None], row: str) -> float | None:
    """The mean over the classes with objects; None where a class is not known, or without any."""
    if None in precision.values():
        return None
    values = [value for rows in precision.values() if (value := rows[row]["moderate"]) is not None]
    return float(np.mean(values)) if values else None


def _r40(level: dict | None) -> float | None:
    return None if level is None else level["r40"]

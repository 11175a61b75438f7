"""Paper A's protocol: candidates of each stage against Pedestrian labels, by range."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import find_candidates
from lidar_perception.candidates.refine import STAGES, Candidates
from lidar_perception.candidates.seed_sources import (
    SeedSource,
    automatic_seed,
    fixed_seed,
    truth_seed,
)
from lidar_perception.candidates.seeds import Seed, load_seed
from lidar_perception.candidates.segmented import Segmented
from lidar_perception.data.recording import Recorded, Recording
from lidar_perception.scoring.centres.matching import RANGE_NAMES, Score, range_bins
from lidar_perception.types import PEDESTRIAN, InputError


@dataclass
class CandidateReport:
    """Scores of the stages over the frames with a pedestrian; times of the steps."""

    scores: dict[str, Score] = field(default_factory=dict)
    times: dict[str, list[float]] = field(default_factory=dict)
    truth: list[np.ndarray] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    frames: int = 0

    def add(self, truth: np.ndarray, found: dict[str, np.ndarray]) -> None:
        """One frame: true pedestrian boxes (M, 7), boxes (K, 7) by stage."""
        self.frames += 1
        self.truth.append(truth)
        for stage, boxes in found.items():
            self.scores.setdefault(stage, Score()).add(boxes, truth)

    def add_times(self, ms: dict[str, float]) -> None:
        for step, value in ms.items():
            self.times.setdefault(step, []).append(value)

    def content(self) -> dict:
        """What the JSON file holds."""
        truth = np.concatenate(self.truth) if self.truth else np.zeros((0, 7))
        by_range = np.bincount(range_bins(truth), minlength=len(RANGE_NAMES))
        return {
            "frames": self.frames,
            "ground_truth": len(truth),
            "ground_truth_by_range": dict(zip(RANGE_NAMES, by_range.tolist())),
            **{stage: score.table() for stage, score in self.scores.items()},
            "ms": {step: float(np.median(values)) for step, values in self.times.items()},
            "skipped": self.skipped,
        }


def pedestrians(recorded: Recorded) -> np.ndarray:
    """(M, 7) true Pedestrian boxes; none where there are no labels."""
    return recorded.truth.of_class(PEDESTRIAN) if recorded.truth else np.zeros((0, 7))


def boxes_by_stage(candidates: Candidates) -> dict[str, np.ndarray]:
    """Name of each stage to its boxes (K, 7)."""
    return {stage: getattr(candidates, stage).boxes for stage in STAGES}


def evaluate(recording: Iterable[Recorded | InputError] | Recording, params: PipelineParams,
             report: CandidateReport) -> Iterator[tuple[Recorded, Segmented, Candidates] | None]:
    """Run the pipeline over a recording and fill the report; yields after every frame what was
    found, or None where the frame has no pedestrian or cannot be read."""
    template = None if params.seed.source == "ground_truth" else load_seed(params.seed.file)
    for recorded in recording:
        if isinstance(recorded, InputError):
            report.skipped.append(str(recorded))
            yield None
            continue
        truth = pedestrians(recorded)
        if len(truth) == 0:
            yield None
            continue
        try:
            segmented, found = find_candidates(recorded.frame, _seed(truth, template, params),
                                               recorded.camera, params)
            ms = found.ms
        except InputError as error:  # no seed, or no camera: this frame has no candidates
            report.skipped.append(f"{recorded.name}: {error}")
            segmented, found, ms = None, Candidates.none(), {}
        report.add(truth, boxes_by_stage(found))
        if ms:
            report.add_times({**ms, "total": sum(ms.values())})
        yield None if segmented is None else (recorded, segmented, found)


def _seed(truth: np.ndarray, template: Seed | None, params: PipelineParams) -> SeedSource:
    if template is None:
        return truth_seed(truth)
    if params.seed.source == "automatic":
        return automatic_seed(template, params)
    return fixed_seed(template)

"""Protocol of paper A: scores of the candidates of each stage on pedestrian labels, by range."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import find_candidates
from lidar_perception.candidates.refine import STAGES, Candidates
from lidar_perception.candidates.seed_sources import SeedSource, make_fixed_source, make_truth_source
from lidar_perception.candidates.seeds import Seed, load_seeds
from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.data.frame import Frame, Recording
from lidar_perception.detectors.automatic_seed import make_automatic_source, warm_up_automatic_seed
from lidar_perception.scoring.centres.matching import RANGE_NAMES, Score, find_range_bins
from lidar_perception.scoring.kitti.camera_objects import select_in_image
from lidar_perception.types import PEDESTRIAN, GroundTruth, InputError

MAX_TIMES = 10_000  # maximum number of stored durations per step


def select_pedestrians(truth: GroundTruth | None) -> np.ndarray:
    """Return the pedestrian boxes (M, 7) of labels; none if truth is None."""
    return np.zeros((0, 7)) if truth is None else truth.select_class(PEDESTRIAN)


def load_pedestrians(frame: Frame, view: bool = True) -> np.ndarray:
    """Load the pedestrian boxes (M, 7) of a frame.

    With `view`, only boxes in the camera's image are returned, to match a pipeline that uses only the
    points in the camera's view.
    """
    truth = frame.truth()
    if view and truth is not None and len(select_pedestrians(truth)):
        truth = select_in_image(truth, frame.calibration())
    return select_pedestrians(truth)


@dataclass(frozen=True)
class CandidateResult:
    """Candidates and labels of one frame.

    Attributes:
        truth: (M, 7) boxes of labelled pedestrians.
        boxes: (K, 7) candidate boxes by stage.
        ms: Duration of each step.
        problem: Reason why there are no candidates, or None.
    """

    truth: np.ndarray
    boxes: dict[str, np.ndarray]
    ms: dict[str, float]
    problem: str | None = None


def measure_candidates(params: PipelineParams, recording: Recording) -> Callable[[Frame], CandidateResult | None]:
    """Make a function that runs the candidate pipeline on frames with a pedestrian (paper A).

    partial(measure_candidates, params) is a StartMeasurement of scoring.run.
    """
    warm_up()
    if params.seed.source == "automatic":
        warm_up_automatic_seed()
    templates = None if params.seed.source == "ground_truth" else load_seeds(params.seed.file)
    return partial(measure_frame, params=params, templates=templates)


def measure_frame(
    frame: Frame, params: PipelineParams, templates: Sequence[Seed] | None = None
) -> CandidateResult | None:
    """Run the pipeline on one frame with the seeds of make_seed_source().

    Returns None for a frame without pedestrians.
    """
    truth = load_pedestrians(frame, params.view.enabled)
    if len(truth) == 0:
        return None
    scan, camera = frame.load(), frame.camera()
    try:
        _, candidates = find_candidates(scan, make_seed_source(truth, templates, params), camera, params)
    except InputError as error:  # no seed or no camera calibration
        return CandidateResult(truth, collect_boxes(Candidates.none()), {}, f"{frame.name}: {error}")
    return CandidateResult(truth, collect_boxes(candidates), candidates.ms)


def collect_boxes(candidates: Candidates) -> dict[str, np.ndarray]:
    """Return the boxes (K, 7) of each stage."""
    return {stage: getattr(candidates, stage).boxes for stage in STAGES}


def make_seed_source(truth: np.ndarray, templates: Sequence[Seed] | None, params: PipelineParams) -> SeedSource:
    """Make the source of a frame's seeds.

    Unless params.seed.source is "automatic", the seeds are the templates or, without any, a labelled
    pedestrian of truth (M, 7), as in the paper.
    """
    if params.seed.source == "automatic":
        return make_automatic_source(params.seed)
    if templates is None:
        return make_truth_source(truth)
    return make_fixed_source(*templates)


@dataclass
class CandidateReport:
    """Scores of each stage on frames with a pedestrian, and durations of the steps.

    Only sums, reasons for skipped frames and the last MAX_TIMES durations of each step are stored, so
    that memory use stays small in a node that runs for days.
    """

    frames: int = 0
    scores: dict[str, Score] = field(default_factory=dict)
    times: dict[str, deque[float]] = field(default_factory=dict)
    true_by_range: np.ndarray = field(default_factory=lambda: np.zeros(len(RANGE_NAMES), int))
    skipped: list[str] = field(default_factory=list)

    def update(self, result: CandidateResult) -> None:
        """Add one frame."""
        if result.problem is not None:
            self.skipped.append(result.problem)
        self.frames += 1
        self.true_by_range += np.bincount(find_range_bins(result.truth), minlength=len(RANGE_NAMES))
        for stage, boxes in result.boxes.items():
            self.scores.setdefault(stage, Score()).update(boxes, result.truth)
        if result.ms:
            self.update_times({**result.ms, "total": sum(result.ms.values())})

    def update_times(self, ms: dict[str, float]) -> None:
        """Add durations of steps in ms. Nodes receive them separately from the candidates."""
        for step, value in ms.items():
            self.times.setdefault(step, deque(maxlen=MAX_TIMES)).append(value)

    def compute(self) -> dict:
        """Return the content of the JSON file."""
        return {
            "frames": self.frames,
            "ground_truth": int(self.true_by_range.sum()),
            "ground_truth_by_range": dict(zip(RANGE_NAMES, self.true_by_range.tolist())),
            **{stage: score.make_rows() for stage, score in self.scores.items()},
            "ms": {step: float(np.median(values)) for step, values in self.times.items()},
            "skipped": self.skipped,
        }

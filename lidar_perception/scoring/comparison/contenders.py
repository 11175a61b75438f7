"""The detectors that are compared: those of the paper, the networks that have weights, hybrids."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lidar_perception.candidates.configurations import BEST, PAPER
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import find_candidates
from lidar_perception.candidates.seed_sources import SeedSource, automatic_seed, truth_seed
from lidar_perception.candidates.seeds import load_seed
from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.data.recording import Recorded
from lidar_perception.detectors.checkpoint import POINTNET, POINTPILLARS
from lidar_perception.detectors.hybrid.candidates import RescoredCandidates
from lidar_perception.detectors.hybrid.params import ConfirmingParams, RescoringParams
from lidar_perception.detectors.hybrid.proposals import ConfirmedProposals
from lidar_perception.detectors.open import AnyDetector, open_detector
from lidar_perception.detectors.pointnet.params import PointNetParams
from lidar_perception.detectors.pointnet.weights_file import weights_file as pointnet_file
from lidar_perception.detectors.pointpillars.config import SIZES, VERSIONS
from lidar_perception.detectors.pointpillars.params import DetectionParams
from lidar_perception.detectors.pointpillars.weights_file import weights_file as pointpillars_file
from lidar_perception.param_fields import with_values
from lidar_perception.scoring.centres.report import pedestrians
from lidar_perception.scoring.comparison.outcomes import Contender
from lidar_perception.types import Detections, InputError

LEAST = 0.05          # score of the boxes that average precision is made of
JUDGED = "PointPillars v4 compact"  # whose proposals the hybrid confirms, if it is there
NO_WEIGHTS = "no weights come with the package; give some with --weights"
PEDESTRIAN_ONLY = ("Pedestrian",)


@dataclass(frozen=True)
class Missing:
    """A detector that could not take part, and why."""

    name: str
    reason: str


@dataclass(frozen=True)
class Opened:
    """A network's detector, which keeps boxes of low score, with its name, kind (POINTPILLARS or
    POINTNET), weights, and the least score of a Pedestrian when it is in use."""

    name: str
    kind: str
    detector: AnyDetector
    source: Path
    operating: float

    def contender(self) -> Contender:
        """By itself."""
        return Contender(self.name, lambda recorded: self.detector(recorded.frame),
                         self.detector.config.classes, self.operating, str(self.source))


def contenders(weights: Sequence[Path] = (), device: str = "auto"
               ) -> tuple[list[Contender], list[Missing]]:
    """Every detector of the package that has weights, those of more weights, and hybrids; and those
    that are missing. InputError for weights that cannot be used."""
    warm_up()
    files, absent = _own_files()
    opened: list[Opened] = []
    for path in [*files, *weights]:
        opened.append(_open(path, device, [each.name for each in opened]))
    found = [each.contender() for each in opened]
    missing = [Missing(name, reason) for name, reason in absent.items()
               if name not in [each.name for each in opened]]
    hybrids, lacking = _hybrids(opened)
    return [*_candidates(), *found, *hybrids], [*missing, *lacking]


def _own_files() -> tuple[list[Path], dict[str, str]]:
    """The weights that come with the package, and of others name and reason why not."""
    wanted: dict[str, Callable[[], Path]] = {
        f"PointPillars {version} {size}": lambda params=DetectionParams(
            version=version, size=size): pointpillars_file(params)
        for size in SIZES for version in VERSIONS}
    wanted["PointNet"] = lambda: pointnet_file(PointNetParams())
    files, absent = [], {}
    for name, place in wanted.items():
        try:
            files.append(place())
        except InputError:
            absent[name] = NO_WEIGHTS
    return files, absent


def _open(path: Path, device: str, taken: Sequence[str]) -> Opened:
    detector = open_detector(path, device, least_score=LEAST)
    kind = detector.header.network
    if kind == POINTPILLARS:
        name = f"PointPillars {detector.config.version} {detector.config.size}"
    else:
        own = detector.config.name
        name = "PointNet" if own == "improved" else f"PointNet ({own})"
    base, number = name, 2
    while name in taken:
        name, number = f"{base} #{number}", number + 1
    operating = type(detector.settings)().scores.pedestrian  # which nobody lowered
    return Opened(name, kind, detector, path, operating)


def _candidates() -> list[Contender]:
    """STM-CPA of both configurations with the paper's seed, and the better one with its own."""
    paper = with_values(PAPER, {"stm.threshold": LEAST})
    best = with_values(BEST, {"confidence.threshold": LEAST})
    return [_pedestrians(name, _run(params), seed, operating) for name, params, seed, operating in (
        ("STM-CPA paper", paper, _labelled, PAPER.stm.threshold),
        ("STM-CPA best", best, _labelled, BEST.confidence.threshold),
        ("STM-CPA best, auto", best, _own_seed(best), BEST.confidence.threshold))]


def _hybrids(opened: Sequence[Opened]) -> tuple[list[Contender], list[Missing]]:
    """STM-CPA and PointPillars, each with the first PointNet."""
    judge = next((each for each in opened if each.kind == POINTNET), None)
    proposers = {each.name: each for each in reversed(opened) if each.kind == POINTPILLARS}
    proposer = proposers.get(JUDGED, next(reversed(proposers.values()), None))
    names = "STM-CPA + PointNet", "STM-CPA + PointNet, auto", "PointPillars + PointNet"
    if judge is None:
        return [], [Missing(name, "there is no PointNet to judge") for name in names]
    found, missing = [], []
    rescored = RescoredCandidates(judge.detector, RescoringParams(threshold=LEAST))
    for name, seed in (names[0], _labelled), (names[1], _own_seed(rescored.pipeline)):
        found.append(_pedestrians(name, rescored, seed, RescoringParams().threshold, judge.source))
    if proposer is None:
        missing.append(Missing(names[2], "there is no PointPillars to propose"))
    else:
        confirmed = ConfirmedProposals(proposer.detector, judge.detector,
                                       ConfirmingParams(threshold=LEAST))
        found.append(Contender(proposer.name.replace("PointPillars", "PP") + " + PointNet",
                               lambda recorded: confirmed(recorded.frame),
                               proposer.detector.config.classes, ConfirmingParams().threshold,
                               f"{proposer.source} {judge.source}"))
    return found, missing


def _run(params: PipelineParams) -> Callable:
    return lambda frame, seed, camera: find_candidates(frame, seed, camera, params)[1].final


def _pedestrians(name: str, detector: Callable, seed_of: Callable[[Recorded], SeedSource | None],
                 operating: float, source: str | Path = "") -> Contender:
    """A detector that needs a seed and a camera."""
    def find(recorded: Recorded) -> Detections | None:
        seed = seed_of(recorded)
        return None if seed is None else detector(recorded.frame, seed, recorded.camera)
    return Contender(name, find, PEDESTRIAN_ONLY, operating, str(source))


def _labelled(recorded: Recorded) -> SeedSource | None:
    """The paper's seed: the nearest label; None in frames without a pedestrian."""
    truth = pedestrians(recorded)
    return truth_seed(truth) if len(truth) else None


def _own_seed(params: PipelineParams) -> Callable[[Recorded], SeedSource]:
    source = automatic_seed(load_seed(), params)
    return lambda recorded: source

"""The detectors that are compared: those of the paper and the networks that have weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from lidar_perception.candidates.configurations import BEST, PAPER
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.seed_sources import (
    SeedSource,
    make_automatic_source,
    make_truth_source,
)
from lidar_perception.candidates.seeds import load_seed
from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.data.frame import Frame
from lidar_perception.detectors.base import NetworkDetector
from lidar_perception.detectors.candidates import CandidateDetector
from lidar_perception.detectors.checkpoint import NETWORKS, POINTNET
from lidar_perception.detectors.contract import Detector
from lidar_perception.detectors.custom import CustomDetector
from lidar_perception.detectors.open import (
    FUSED,
    LOAD,
    ConfigurableDetector,
    open_detector,
    resolve_weights,
)
from lidar_perception.detectors.params import MIN_SCORE
from lidar_perception.detectors.pointnet.params import PointNetParams
from lidar_perception.detectors.pointnet.weights_file import weights_file as pointnet_file
from lidar_perception.detectors.pointpillars.config import SIZES, VERSIONS
from lidar_perception.detectors.pointpillars.params import PointPillarsParams
from lidar_perception.detectors.pointpillars.weights_file import weights_file as pointpillars_file
from lidar_perception.ground.params import set_sensor_height
from lidar_perception.param_fields import with_values
from lidar_perception.scoring.centres.report import load_pedestrians
from lidar_perception.scoring.comparison.outcomes import Contender
from lidar_perception.types import CLASSES, PEDESTRIAN, SENSOR_HEIGHT, InputError

NO_WEIGHTS = "no weights come with the package; give some with --weights"
PERSON = CLASSES[PEDESTRIAN]
CANDIDATES = "candidates"

Settings = Mapping[str, Mapping[str, Any]]  # kind of a detector -> dotted name -> value
NO_SETTINGS: Settings = {}


@dataclass(frozen=True)
class Missing:
    """A detector that could not take part, and why."""

    name: str
    reason: str


@dataclass(frozen=True)
class Opened:
    """A network's detector, with its name and weights."""

    name: str
    detector: NetworkDetector | CustomDetector
    source: Path

    def contender(self) -> Contender:
        """By itself."""
        return always(self.name, self.detector, str(self.source))


def always(name: str, detector: Detector, source: str) -> Contender:
    """One detector for all frames; it keeps boxes of low score, too."""
    kept = detector.with_min_score(MIN_SCORE)
    return Contender(name, lambda frame: kept, detector.classes,
                     detector.min_scores.get(PERSON, 1.0), source)


def contenders(weights: Sequence[Path] = (), device: str = "auto",
               sensor_height: float = SENSOR_HEIGHT, range: str = "auto",
               settings: Settings = NO_SETTINGS) -> tuple[list[Contender], list[Missing]]:
    """Open every detector of the package that has weights.

    Args:
        weights: files of more networks.
        sensor_height: height of the sensor above the ground in metres.
        range: of the detectors that have one, see open_detector.
        settings: parameters by the kind of their detector: candidates, pointpillars, pointnet,
            fused.

    Returns:
        The detectors, and those that are missing.

    Raises:
        InputError: weights or parameters cannot be used.
    """
    warm_up()

    def opened_as(path: str | Path) -> ConfigurableDetector:
        kind = resolve_weights(path)[0]
        return open_detector(path, device, sensor_height=sensor_height,
                             range="auto" if kind == POINTNET or kind not in LOAD else range,
                             settings=settings.get(kind, {}))
    files, absent = _own_files()
    opened: list[Opened] = []
    for path in [*files, *weights]:
        detector = opened_as(path)
        if str(path) in LOAD or not isinstance(detector, NetworkDetector | CustomDetector):
            raise InputError(f"{path} takes part anyway; give files of weights")
        opened.append(Opened(_name(detector, [FUSED, *(each.name for each in opened)]), detector,
                             path))
    found = [each.contender() for each in opened]
    missing = [Missing(name, reason) for name, reason in absent.items()
               if name not in [each.name for each in opened]]
    try:
        found.append(always(FUSED, opened_as(FUSED), "those of PointPillars and PointNet"))
    except InputError as error:
        missing.append(Missing(FUSED, str(error)))
    paper, best = (with_values(set_sensor_height(params, sensor_height),
                               settings.get(CANDIDATES, {})) for params in (PAPER, BEST))
    return [*_candidates(paper, best), *found], missing


def opened_in_a_process(*asked: Any) -> list[Contender]:
    """The contenders alone; a function that can be sent to another process."""
    return contenders(*asked)[0]


def _own_files() -> tuple[list[Path], dict[str, str]]:
    """The weights that come with the package, and of others name and reason why not."""
    wanted: dict[str, Callable[[], Path]] = {
        f"PointPillars {version} {size}": partial(
            pointpillars_file, PointPillarsParams(version=version, size=size))
        for size in SIZES for version in VERSIONS}
    wanted["PointNet"] = partial(pointnet_file, PointNetParams())
    files, absent = [], {}
    for name, place in wanted.items():
        try:
            files.append(place())
        except InputError:
            absent[name] = NO_WEIGHTS
    return files, absent


def _name(detector: NetworkDetector | CustomDetector, taken: Sequence[str]) -> str:
    """Return the name of a detector, with a number if the name is taken."""
    if isinstance(detector, CustomDetector):
        name = detector.name
    elif detector.group in NETWORKS:
        name = f"{NETWORKS[detector.group][0]} {detector.networks[0].config.title}".strip()
    else:
        name = detector.group
    base, number = name, 2
    while name in taken:
        name, number = f"{base} #{number}", number + 1
    return name


def _candidates(paper: PipelineParams, best: PipelineParams) -> list[Contender]:
    """STM-CPA of both configurations with the paper's seed, and the better one with its own."""
    return [_seeded("STM-CPA paper", CandidateDetector, paper, _labelled),
            _seeded("STM-CPA best", CandidateDetector, best, _labelled),
            _seeded("STM-CPA best, auto", CandidateDetector, best, _own_seed(best))]


def _seeded(name: str, make: Callable[..., Detector], params: PipelineParams,
            seed_of: Callable[[Frame], SeedSource | None]) -> Contender:
    """A detector make(seed, camera, params) that needs a seed for each frame; where there is no
    camera it sees the whole scan, as the others do."""
    uncropped = with_values(params, {"view.enabled": False})

    def detector_of(frame: Frame) -> Detector | None:
        seed, camera = seed_of(frame), frame.camera()
        return None if seed is None else make(
            seed, camera, uncropped if camera is None else params).with_min_score(MIN_SCORE)
    operating = make(_no_seed, None, params).min_scores[PERSON]
    return Contender(name, detector_of, (PERSON,), operating)


def _no_seed(segmented):
    raise InputError("there is no seed")


def _labelled(frame: Frame) -> SeedSource | None:
    """The paper's seed: the nearest label; None in frames without a pedestrian."""
    truth = load_pedestrians(frame)
    return make_truth_source(truth) if len(truth) else None


def _own_seed(params: PipelineParams) -> Callable[[Frame], SeedSource]:
    source = make_automatic_source(load_seed(), params)
    return lambda frame: source

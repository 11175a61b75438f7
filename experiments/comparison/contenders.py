"""Contenders of the comparison: STM-CPA, and the networks that have weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from experiments.comparison.outcomes import Contender
from lidar_perception.candidates.configurations import BEST, PAPER
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.seed_sources import SeedSource, make_truth_source
from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.data.frame import Frame
from lidar_perception.detectors.automatic_seed import make_automatic_source
from lidar_perception.detectors.base import NetworkDetector
from lidar_perception.detectors.candidates import CandidateDetector
from lidar_perception.detectors.checkpoint import NETWORKS, POINTNET
from lidar_perception.detectors.contract import Detector
from lidar_perception.detectors.custom import CustomDetector
from lidar_perception.detectors.open import FUSED, LOAD, ConfigurableDetector, open_detector, resolve_weights
from lidar_perception.detectors.params import MIN_SCORE
from lidar_perception.detectors.pointnet.params import PointNetParams
from lidar_perception.detectors.pointpillars.config import SIZES, VERSIONS
from lidar_perception.detectors.pointpillars.params import PointPillarsParams
from lidar_perception.detectors.weights_file import find_pointnet_weights, find_pointpillars_weights
from lidar_perception.ground.params import set_sensor_height
from lidar_perception.param_fields import with_values
from lidar_perception.scoring.centres.report import load_pedestrians
from lidar_perception.types import CLASSES, PEDESTRIAN, SENSOR_HEIGHT, InputError

NO_WEIGHTS = "the package has no weights for this detector; give a checkpoint with --weights"
PERSON = CLASSES[PEDESTRIAN]
CANDIDATES = "candidates"

Settings = Mapping[str, Mapping[str, Any]]  # kind of detector -> dotted parameter name -> value
NO_SETTINGS: Settings = {}


@dataclass(frozen=True)
class MissingDetector:
    """A detector without weights, and the reason."""

    name: str
    reason: str


@dataclass(frozen=True)
class OpenedDetector:
    """A detector with its name and weights."""

    name: str
    detector: NetworkDetector | CustomDetector
    source: Path

    def to_contender(self) -> Contender:
        return make_contender(self.name, self.detector, str(self.source))


def make_contender(name: str, detector: Detector, source: str) -> Contender:
    """Return a contender that runs one detector on all frames and keeps boxes with low scores."""
    detector_for_ap = detector.with_min_score(MIN_SCORE)
    threshold = detector.min_scores.get(PERSON, 1.0)
    return Contender(name, lambda frame: detector_for_ap, detector.classes, threshold, source)


def open_contenders(
    weights: Sequence[Path] = (),
    device: str = "auto",
    sensor_height: float = SENSOR_HEIGHT,
    range: str = "auto",
    settings: Settings = NO_SETTINGS,
) -> tuple[list[Contender], list[MissingDetector]]:
    """Open every detector of the package that has weights.

    Args:
        weights: Checkpoints of additional networks.
        device: Device of the networks.
        sensor_height: Height of the sensor above the ground, metres.
        range: Range of the detectors that have one, see open_detector.
        settings: Parameters by kind of detector: candidates, pointpillars, pointnet, fused.

    Returns:
        The opened detectors, and the missing ones.

    Raises:
        InputError: Weights or parameters cannot be used.
    """
    warm_up()

    def open_one(path: str | Path) -> ConfigurableDetector:
        kind = resolve_weights(path)[0]
        return open_detector(
            path,
            device,
            sensor_height=sensor_height,
            range="auto" if kind == POINTNET or kind not in LOAD else range,
            settings=settings.get(kind, {}),
        )

    files, missing_reasons = _find_package_files()
    opened_detectors: list[OpenedDetector] = []
    for path in [*files, *weights]:
        detector = open_one(path)
        if str(path) in LOAD or not isinstance(detector, NetworkDetector | CustomDetector):
            raise InputError(f"{path} is already in the comparison; give other weights")
        name = _make_name(detector, [FUSED, *(other.name for other in opened_detectors)])
        opened_detectors.append(OpenedDetector(name, detector, path))
    contenders = [detector.to_contender() for detector in opened_detectors]
    opened_names = [detector.name for detector in opened_detectors]
    missing = [MissingDetector(name, reason) for name, reason in missing_reasons.items() if name not in opened_names]
    try:
        contenders.append(make_contender(FUSED, open_one(FUSED), "those of PointPillars and PointNet"))
    except InputError as error:
        missing.append(MissingDetector(FUSED, str(error)))
    paper, best = (
        with_values(set_sensor_height(params, sensor_height), settings.get(CANDIDATES, {})) for params in (PAPER, BEST)
    )
    return [*_make_candidate_contenders(paper, best), *contenders], missing


def open_available_contenders(*arguments: Any) -> list[Contender]:
    """Return only the opened detectors of open_contenders. Worker processes can import this function."""
    return open_contenders(*arguments)[0]


def _find_package_files() -> tuple[list[Path], dict[str, str]]:
    """Return the weights in the package, and {name of a detector without weights: reason}."""
    finders: dict[str, Callable[[], Path]] = {
        f"PointPillars {version} {size}": partial(
            find_pointpillars_weights, PointPillarsParams(version=version, size=size)
        )
        for size in SIZES
        for version in VERSIONS
    }
    finders["PointNet"] = partial(find_pointnet_weights, PointNetParams())
    files, missing_reasons = [], {}
    for name, find in finders.items():
        try:
            files.append(find())
        except InputError:
            missing_reasons[name] = NO_WEIGHTS
    return files, missing_reasons


def _make_name(detector: NetworkDetector | CustomDetector, used_names: Sequence[str]) -> str:
    """Return the name of a detector, with a number if the name is already used."""
    if isinstance(detector, CustomDetector):
        name = detector.name
    elif detector.group in NETWORKS:
        name = f"{NETWORKS[detector.group][0]} {detector.networks[0].config.title}".strip()
    else:
        name = detector.group
    base, number = name, 2
    while name in used_names:
        name, number = f"{base} #{number}", number + 1
    return name


def _make_candidate_contenders(paper: PipelineParams, best: PipelineParams) -> list[Contender]:
    """Return STM-CPA with the paper's seed, and `best` with the automatic seed."""
    automatic_source = make_automatic_source(best.seed)
    return [
        _make_seeded_contender("STM-CPA paper", paper, _find_labelled_seed),
        _make_seeded_contender("STM-CPA best", best, _find_labelled_seed),
        _make_seeded_contender("STM-CPA best, auto", best, lambda frame: automatic_source),
    ]


def _make_seeded_contender(
    name: str, params: PipelineParams, find_seed: Callable[[Frame], SeedSource | None]
) -> Contender:
    """Return a contender that needs a seed in each frame.

    Without a camera it runs on the full scan, as the other detectors do.
    """
    uncropped_params = with_values(params, {"view.enabled": False})

    def make_detector(frame: Frame) -> Detector | None:
        seed, camera = find_seed(frame), frame.camera()
        return (
            None
            if seed is None
            else CandidateDetector(seed, camera, uncropped_params if camera is None else params).with_min_score(
                MIN_SCORE
            )
        )

    threshold = CandidateDetector(_raise_no_seed, None, params).min_scores[PERSON]
    return Contender(name, make_detector, (PERSON,), threshold)


def _raise_no_seed(segmented):
    raise InputError("there is no seed")


def _find_labelled_seed(frame: Frame) -> SeedSource | None:
    """Return the paper's seed, which is the nearest labelled pedestrian; None in frames without one."""
    truth = load_pedestrians(frame)
    return make_truth_source(truth) if len(truth) else None

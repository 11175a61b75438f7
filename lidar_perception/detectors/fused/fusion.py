"""What the fused detector is made of: two networks, and the curves fitted to what they say
together. `train fused` writes a file of it; fusion.json is the one that comes with the package. It
is read without loading torch.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from hashlib import sha256
from os.path import relpath
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.classes import DETECTED
from lidar_perception.detectors.fused.params import FusedParams
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.detectors.pointnet.weights_file import judge_file
from lidar_perception.detectors.pointpillars.config import NetworkConfig
from lidar_perception.detectors.pointpillars.params import PointPillarsParams
from lidar_perception.detectors.pointpillars.weights_file import weights_file as proposer_file
from lidar_perception.detectors.weights_file import existing
from lidar_perception.runs.files import read_text, shorten_error, write_text
from lidar_perception.types import InputError

PACKAGE = Path(__file__).with_name("fusion.json")
SUFFIX = ".json"      # of such a file, where a checkpoint could stand
MOST_BYTES = 10**6
MOST = 1000.0         # of any log-odds
MOST_KNOTS = 64
NETWORKS = NetworkConfig.network, PointNetConfig.network
KNOTS = {  # source -> where its curve bends, log-odds
    "network": (-4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.5),
    "classifier": (-6.0, -4.0, -2.0, 0.0, 2.0, 4.0, 6.0),
    "silhouette": (-4.0, -2.5, -1.0, 0.0, 1.0, 2.5),
}

# By class, the model of the log-odds of its sources, see candidates/curves.py.
Models = Mapping[str, Any]


@dataclass(frozen=True)
class Fusion:
    """proposer, classifier: files of the weights of PointPillars and of the cluster network; models
    were fitted to networks whose files have these digests; fitted_to: what is known of that."""

    proposer: Path
    classifier: Path
    digests: tuple[str, str]
    models: Models
    fitted_to: Mapping[str, Any]

    @property
    def doubt(self) -> str | None:
        """What to say where the curves were fitted to other weights, None where they were not."""
        others = [str(path) for path, known in zip((self.proposer, self.classifier), self.digests)
                  if digest(path) != known]
        if not others:
            return None
        return (f"the curves of fused were fitted to other weights than {' and '.join(others)}, so "
                "that its scores are no checked probabilities; `lidar-perception train fused` fits "
                "them")

    def doubts(self, classes: Iterable[str]) -> list[str]:
        """The doubt, and what to say where the proposer's classes are not all among the curves'."""
        others = [name for name in classes if name not in self.models]
        return [*filter(None, [self.doubt]), *(
            [f"fused detects no {' and no '.join(others)}, as there are curves for "
             f"{', '.join(self.models)} alone; {self.proposer} by itself does"] if others else [])]


def digest(path: Path) -> str:
    """The sha256 of a file, as hex digits."""
    return sha256(path.read_bytes()).hexdigest()


def fusion_of(path: str | Path = "", params: FusedParams = FusedParams()) -> Fusion:
    """What path names, or else params: a file of `train fused`, or PointPillars' weights, with the
    curves that come with the package. InputError if something is not there, or is not what it
    should be."""
    named = str(path) if str(path) not in ("", ".") else params.weights
    if named.endswith(SUFFIX):
        if params.classifier:
            raise InputError(f"{named} names its own cluster network; leave fused.classifier "
                             "empty")
        return read_fusion(existing(named, "fused.weights"))
    own = read_fusion(PACKAGE)
    return replace(own, proposer=existing(named, "fused.weights") if named else own.proposer,
                   classifier=existing(params.classifier, "fused.classifier")
                   if params.classifier else own.classifier)


def weights_file(params: FusedParams) -> Path:
    """The file that params name, or else PointPillars' weights of the package. InputError if it, or
    another part, is not there."""
    fusion = fusion_of("", params)
    return Path(params.weights) if params.weights else fusion.proposer


@cache
def package_models() -> Models:
    """Those that come with the package."""
    return json.loads(PACKAGE.read_text())["classes"]


def read_fusion(path: Path) -> Fusion:
    """The file at path. InputError if it is none, or names weights that are not there."""
    try:
        content = json.loads(read_text(path, MOST_BYTES))
        known, models = [content[name] for name in NETWORKS], content["classes"]
        files, digests = ([str(part[key]) for part in known] for key in ("file", "sha256"))
        fitted_to = dict(content["fitted_to"])
        _check(models)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError,
            RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} is no file of `lidar-perception train fused` "
                         f"({shorten_error(error)})"
                         ) from None
    proposer, classifier = (path.parent / file if file else default
                            for file, default in zip(files, _shipped()))
    for part in (proposer, classifier):
        if not part.is_file():
            raise InputError(f"{path} is made of {part}, which is not there; bring it back, or fit "
                             "again with `lidar-perception train fused`")
    return Fusion(proposer, classifier, (digests[0], digests[1]), models, fitted_to)


def write_fusion(path: Path, weights: tuple[Path | None, Path | None], models: Models,
                 fitted_to: Mapping[str, Any]) -> None:
    """Write what read_fusion reads. weights: the files of both networks, None for those that come
    with the package; they stay where they are. InputError where it cannot be written."""
    parts = {}
    for name, file, default in zip(NETWORKS, weights, _shipped()):
        parts[name] = {"file": relpath(file, path.parent) if file else "",
                       "sha256": digest(file or default)}
    write_text(path, json.dumps({**parts, "fitted_to": fitted_to, "classes": models}, indent=1))


def _shipped() -> tuple[Path, Path]:
    """Both networks' weights that come with the package. InputError if they are not there."""
    return proposer_file(PointPillarsParams()), judge_file()


def _check(models: Any) -> None:
    """ValueError, TypeError or KeyError where these are no models."""
    for name, model in models.items():
        if name not in DETECTED:
            raise ValueError(f"unknown class {name[:40]!r}")
        _numbers([model["bias"]])
        for source, curve in model["curves"].items():
            if source not in KNOTS:
                raise ValueError(f"unknown source {source[:40]!r}")
            knots, values = _numbers(curve["knots"]), _numbers(curve["values"])
            _numbers([curve.get("unknown", 0.0)])
            if (len(knots) != len(values) or not (np.diff(knots) > 0).all()
                    or not (np.diff(values) >= 0).all()):
                raise ValueError(f"the curve of {source} does not rise")


def _numbers(values: Any) -> np.ndarray:
    """(K,) float64. ValueError for what are none."""
    if not all(type(value) in (int, float) for value in values):
        raise ValueError("a log-odds is no number")
    numbers = np.array(values, np.float64)
    if not 0 < len(numbers) <= MOST_KNOTS or not (np.abs(numbers) <= MOST).all():
        raise ValueError(f"log-odds must be numbers up to {MOST:g}")
    return numbers

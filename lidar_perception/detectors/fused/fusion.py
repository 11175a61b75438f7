"""Fusion files: the two networks of the fused detector and the curves that combine their scores.

`train fused` writes fusion files; fusion.json is shipped with the package. Reading does not import
torch.
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
from lidar_perception.detectors.pointpillars.config import NetworkConfig
from lidar_perception.detectors.weights_file import find_classifier_weights, find_proposer_weights, require_weights
from lidar_perception.runs.files import read_text, shorten_error, write_text
from lidar_perception.types import InputError

SHIPPED_FILE = Path(__file__).with_name("fusion.json")
WITHOUT_INTENSITY = "classes_without_intensity"  # key of the curves for clouds without intensity
SUFFIX = ".json"  # suffix of fusion files
MAX_BYTES = 10**6
MAX_LOG_ODDS = 1000.0
MAX_KNOTS = 64
NETWORKS = NetworkConfig.network, PointNetConfig.network
KNOTS = {  # source -> knots of its piecewise linear curve, in log-odds
    "network": (-4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.5),
    "classifier": (-6.0, -4.0, -2.0, 0.0, 2.0, 4.0, 6.0),
    "silhouette": (-4.0, -2.5, -1.0, 0.0, 1.0, 2.5),
}

# Class -> model of the sources' log-odds, see candidates/confidence.py.
Models = Mapping[str, Any]


@dataclass(frozen=True)
class Fusion:
    """Content of a fusion file.

    Attributes:
        proposer, classifier: weights of PointPillars and of PointNet.
        digests: sha256 of the weights that `models` were fitted to.
        models: curves by class.
        fitted_to: data and numbers of proposals that the curves were fitted to.
        models_without_intensity: curves for clouds without intensity; None: `models`.
    """

    proposer: Path
    classifier: Path
    digests: tuple[str, str]
    models: Models
    fitted_to: Mapping[str, Any]
    models_without_intensity: Models | None = None

    @property
    def curve_warning(self) -> str | None:
        """Warning if the curves were fitted to different weights, or None."""
        unknown_files = [
            str(path)
            for path, digest in zip((self.proposer, self.classifier), self.digests)
            if compute_digest(path) != digest
        ]
        if not unknown_files:
            return None
        return (
            f"the curves of fused were not fitted to {' and '.join(unknown_files)}, so its scores are not "
            "calibrated probabilities; fit the curves with `lidar-perception train fused`"
        )

    def find_warnings(self, classes: Iterable[str]) -> list[str]:
        """Return the curve_warning, if any, and a warning about classes of the proposer without a curve."""
        warnings = [self.curve_warning] if self.curve_warning else []
        if missing_classes := [name for name in classes if name not in self.models]:
            warnings.append(
                f"fused does not detect {' and '.join(missing_classes)}, because it has curves only for "
                f"{', '.join(self.models)}; use {self.proposer} alone to detect them"
            )
        return warnings


def compute_digest(path: Path) -> str:
    """Return the sha256 of a file as hex digits."""
    return sha256(path.read_bytes()).hexdigest()


def find_fusion(path: str | Path = "", params: FusedParams = FusedParams()) -> Fusion:
    """Find the networks and curves of the fused detector.

    Args:
        path: a fusion file, or weights of PointPillars, which are used with the shipped curves;
            empty: `params.weights`.

    Raises:
        InputError: a file is missing or invalid.
    """
    name = str(path) if str(path) not in ("", ".") else params.weights
    if name.endswith(SUFFIX):
        if params.classifier:
            raise InputError(f"{name} already refers to PointNet weights; leave fused.classifier empty")
        return read_fusion(require_weights(name, "fused.weights"))
    shipped_fusion = read_fusion(SHIPPED_FILE)
    return replace(
        shipped_fusion,
        proposer=require_weights(name, "fused.weights") if name else shipped_fusion.proposer,
        classifier=require_weights(params.classifier, "fused.classifier")
        if params.classifier
        else shipped_fusion.classifier,
    )


def find_fused_weights(params: FusedParams) -> Path:
    """Return `params.weights`, by default the path of the shipped weights of PointPillars.

    Raises:
        InputError: this file or another file of the detector is missing.
    """
    fusion = find_fusion("", params)
    return Path(params.weights) if params.weights else fusion.proposer


@cache
def load_shipped_models() -> Models:
    """Load the curves that are shipped with the package."""
    return json.loads(SHIPPED_FILE.read_text())["classes"]


def read_fusion(path: Path) -> Fusion:
    """Read a fusion file.

    Raises:
        InputError: the file is invalid, or its weights are missing.
    """
    try:
        content = json.loads(read_text(path, MAX_BYTES))
        networks, models = [content[name] for name in NETWORKS], content["classes"]
        files, digests = ([str(part[key]) for part in networks] for key in ("file", "sha256"))
        fitted_to, models_without_intensity = dict(content["fitted_to"]), content.get(WITHOUT_INTENSITY)
        _check_models(models)
        if models_without_intensity is not None:
            _check_models(models_without_intensity)
            if set(models_without_intensity) != set(models):
                raise ValueError(f"{WITHOUT_INTENSITY} has different classes than `classes`")
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} was not written by `lidar-perception train fused` ({shorten_error(error)})") from None
    proposer, classifier = (
        path.parent / file if file else default for file, default in zip(files, _find_shipped_weights())
    )
    for weights in (proposer, classifier):
        if not weights.is_file():
            raise InputError(
                f"{path} refers to {weights}, which does not exist; restore the file, or run "
                "`lidar-perception train fused` again"
            )
    return Fusion(proposer, classifier, (digests[0], digests[1]), models, fitted_to, models_without_intensity)


def write_fusion(
    path: Path,
    weights: tuple[Path | None, Path | None],
    models: Models,
    fitted_to: Mapping[str, Any],
    models_without_intensity: Models | None = None,
) -> None:
    """Write a fusion file, which refers to the weights by relative paths.

    Args:
        weights: weights of PointPillars and of PointNet; None: the shipped ones.

    Raises:
        InputError: the file cannot be written.
    """
    parts = {}
    for name, file, default in zip(NETWORKS, weights, _find_shipped_weights()):
        parts[name] = {"file": relpath(file, path.parent) if file else "", "sha256": compute_digest(file or default)}
    optional_parts = {WITHOUT_INTENSITY: models_without_intensity} if models_without_intensity else {}
    write_text(path, json.dumps({**parts, "fitted_to": fitted_to, "classes": models, **optional_parts}, indent=1))


def _find_shipped_weights() -> tuple[Path, Path]:
    """Return the paths of the shipped weights of both networks; raise InputError if they are missing."""
    return find_proposer_weights(), find_classifier_weights()


def _check_models(models: Any) -> None:
    """Raise a ValueError, TypeError or KeyError for invalid models."""
    for name, model in models.items():
        if name not in DETECTED:
            raise ValueError(f"unknown class {name[:40]!r}")
        _parse_log_odds([model["bias"]])
        for source, curve in model["curves"].items():
            if source not in KNOTS:
                raise ValueError(f"unknown source {source[:40]!r}")
            knots, values = _parse_log_odds(curve["knots"]), _parse_log_odds(curve["values"])
            _parse_log_odds([curve.get("unknown", 0.0)])
            if len(knots) != len(values) or not (np.diff(knots) > 0).all() or not (np.diff(values) >= 0).all():
                raise ValueError(f"knots and values of the curve of {source} must be increasing")


def _parse_log_odds(values: Any) -> np.ndarray:
    """Convert log-odds to (K,) float64; raise ValueError if they are invalid."""
    if not all(type(value) in (int, float) for value in values):
        raise ValueError("log-odds must be numbers")
    log_odds = np.array(values, np.float64)
    if not 0 < len(log_odds) <= MAX_KNOTS or not (np.abs(log_odds) <= MAX_LOG_ODDS).all():
        raise ValueError(f"expected 1 to {MAX_KNOTS} log-odds between -{MAX_LOG_ODDS:g} and {MAX_LOG_ODDS:g}")
    return log_odds

"""Fusion files: the two networks of the fused detector and the curves that combine their scores.

`train fused` writes such a file; fusion.json ships with the package. Reading does not import torch.
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
from lidar_perception.detectors.weights_file import find_judge_weights, find_proposer_weights, require_weights
from lidar_perception.runs.files import read_text, shorten_error, write_text
from lidar_perception.types import InputError

PACKAGE = Path(__file__).with_name("fusion.json")
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
        fitted_to: data and numbers of proposals of the fit.
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
        """Warning if the curves were fitted to other weights, or None."""
        refitted = [
            str(path)
            for path, digest in zip((self.proposer, self.classifier), self.digests)
            if compute_digest(path) != digest
        ]
        if not refitted:
            return None
        return (
            f"the curves of fused were not fitted to {' and '.join(refitted)}, so its scores are not "
            "calibrated probabilities; fit the curves with `lidar-perception train fused`"
        )

    def find_warnings(self, classes: Iterable[str]) -> list[str]:
        """Return the curve_warning, if any, and a warning about classes without a curve.

        Args:
            classes: classes of the proposer.
        """
        warnings = [self.curve_warning] if self.curve_warning else []
        if missing := [name for name in classes if name not in self.models]:
            warnings.append(
                f"fused detects no {' and no '.join(missing)}, because it has curves only for "
                f"{', '.join(self.models)}; use {self.proposer} alone to detect them"
            )
        return warnings


def compute_digest(path: Path) -> str:
    """Return the sha256 of a file as hex digits."""
    return sha256(path.read_bytes()).hexdigest()


def find_fusion(path: str | Path = "", params: FusedParams = FusedParams()) -> Fusion:
    """Find the networks and curves of the fused detector.

    Args:
        path: a fusion file, or PointPillars' weights, which are used with the shipped curves;
            empty: `params.weights`.

    Raises:
        InputError: a file is missing or invalid.
    """
    name = str(path) if str(path) not in ("", ".") else params.weights
    if name.endswith(SUFFIX):
        if params.classifier:
            raise InputError(f"{name} refers to its own PointNet weights; leave fused.classifier empty")
        return read_fusion(require_weights(name, "fused.weights"))
    shipped = read_fusion(PACKAGE)
    return replace(
        shipped,
        proposer=require_weights(name, "fused.weights") if name else shipped.proposer,
        classifier=require_weights(params.classifier, "fused.classifier") if params.classifier else shipped.classifier,
    )


def find_fused_weights(params: FusedParams) -> Path:
    """Return the path `params.weights`, by default the shipped weights of PointPillars.

    Raises:
        InputError: this file or another part of the detector is missing.
    """
    fusion = find_fusion("", params)
    return Path(params.weights) if params.weights else fusion.proposer


@cache
def load_shipped_models() -> Models:
    """Load the curves that ship with the package."""
    return json.loads(PACKAGE.read_text())["classes"]


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
                raise ValueError(f"{WITHOUT_INTENSITY} has other classes")
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} was not written by `lidar-perception train fused` ({shorten_error(error)})") from None
    proposer, classifier = (
        path.parent / file if file else default for file, default in zip(files, _find_shipped_weights())
    )
    for part in (proposer, classifier):
        if not part.is_file():
            raise InputError(
                f"{path} needs {part}, which does not exist; restore the file, or run "
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
        weights: files of PointPillars and PointNet; None: the shipped one.

    Raises:
        InputError: the file cannot be written.
    """
    parts = {}
    for name, file, default in zip(NETWORKS, weights, _find_shipped_weights()):
        parts[name] = {"file": relpath(file, path.parent) if file else "", "sha256": compute_digest(file or default)}
    optional_parts = {WITHOUT_INTENSITY: models_without_intensity} if models_without_intensity else {}
    write_text(path, json.dumps({**parts, "fitted_to": fitted_to, "classes": models, **optional_parts}, indent=1))


def _find_shipped_weights() -> tuple[Path, Path]:
    """Return the paths of the shipped weights of both networks. InputError if they are missing."""
    return find_proposer_weights(), find_judge_weights()


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
                raise ValueError(f"the curve of {source} is not increasing")


def _parse_log_odds(values: Any) -> np.ndarray:
    """Convert log-odds to (K,) float64. ValueError if they are invalid or above MAX_LOG_ODDS."""
    if not all(type(value) in (int, float) for value in values):
        raise ValueError("log-odds must be numbers")
    numbers = np.array(values, np.float64)
    if not 0 < len(numbers) <= MAX_KNOTS or not (np.abs(numbers) <= MAX_LOG_ODDS).all():
        raise ValueError(f"log-odds must be numbers up to {MAX_LOG_ODDS:g}")
    return numbers

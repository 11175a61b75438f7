"""Parameters of the hybrid detectors."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.param_fields import Params, param

BOXES = ("cluster", "network")


@dataclass(frozen=True)
class RescoringParams(Params):
    """STM-CPA candidates, scored again by the class of their points."""

    threshold: float = param(0.4, "Minimum score of a detection, a probability.", low=0.0, high=1.0)
    min_confidence: float = param(0.0, "Candidates with a lower confidence are left out before "
                                       "the network runs.", low=0.0, high=1.0)
    box: str = param("network", "cluster: around the visible points, down to the ground. "
                     "network: around the whole pedestrian, as the network estimates it.",
                     choices=BOXES)
    overlap: float = param(0.1, "Of two boxes of the network whose overlap from above exceeds "
                                "this, the better one stays: they are two pieces of one person.",
                           low=0.0, high=1.0)


@dataclass(frozen=True)
class ConfirmingParams(Params):
    """Proposals of PointPillars, confirmed by the shape of what is in them."""

    weight: float = param(0.5, "Weight of the network's probability in the score, a geometric "
                          "mean: 0 keeps the proposal's score, 1 takes the network's.",
                          low=0.0, high=1.0)
    threshold: float = param(0.3, "Minimum score of a detection, which is no probability.",
                             low=0.0, high=1.0)
    margin: float = param(0.2, "Points up to this far outside a proposal's box belong to its "
                               "cluster.",
                          unit="m", low=0.0, high=5.0)
    min_points: int = param(5, "A proposal with fewer points above the ground keeps its own "
                               "score.", low=1, high=1_000_000)

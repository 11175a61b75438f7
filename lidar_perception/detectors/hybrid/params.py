"""Parameters of the hybrid detectors."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.param_fields import Params, param

BOXES = ("cluster", "network")


@dataclass(frozen=True)
class WeightParams(Params):
    """How much the network's probability weighs beside the score that a box comes with."""

    weight: float = param(0.5, "Weight of the network's probability in the score, a geometric "
                          "mean: with 0 the first score stands alone, with 1 the network's.",
                          low=0.0, high=1.0)
    threshold: float = param(0.3, "Least score of a detection.", low=0.0, high=1.0)


@dataclass(frozen=True)
class RescoringParams(WeightParams):
    """STM-CPA candidates, scored again by the class of their points."""

    min_confidence: float = param(0.05, "Candidates less like a pedestrian than this are left "
                                    "out before the network is asked.", low=0.0, high=1.0)
    box: str = param("network", "cluster: around the points that are seen, down to the ground. "
                     "network: around the whole pedestrian, as the network makes it out.",
                     choices=BOXES)
    overlap: float = param(0.1, "Of two boxes of the network that overlap by more than this, seen "
                           "from above, the better stays: two pieces of a person are one.",
                           low=0.0, high=1.0)


@dataclass(frozen=True)
class ConfirmingParams(WeightParams):
    """Proposals of PointPillars, confirmed by the shape of what is in them."""

    margin: float = param(0.2, "Points so far outside a proposal's box belong to its cluster, too.",
                          unit="m", low=0.0, high=5.0)
    min_points: int = param(5, "A proposal with fewer points that are not ground keeps its own "
                              "score.", low=1, high=1_000_000)

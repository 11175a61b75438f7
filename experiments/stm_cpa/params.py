"""Parameters of the STM-CPA experiment. They are part of the settings of a run."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.candidates.configurations import PAPER
from lidar_perception.param_fields import with_values

# Readings of Table 2 and Section 3.5 that the text allows, see experiments/departures.py.
READINGS = {
    "window stretched, yaw": PAPER,
    "window metric, yaw": with_values(PAPER, {"stm.window": "metric"}),
    "window stretched, PCA": with_values(PAPER, {"stm.axis": "pca"}),
    "window metric, PCA": with_values(PAPER, {"stm.window": "metric", "stm.axis": "pca"}),
}


@dataclass(frozen=True)
class StmCpaParams:
    """Parameters that the paper varies in Sections 4.2 and 4.5.

    Attributes:
        search_eps, search_min_samples: Values to try. The paper does not list the values that it
            tried; these include all that it mentions.
        search_distance: Maximum distance of 3D centres of a hit in the search, metres.
        cpa_steps: Maximum number of CPA steps in the sweep.
        cpa_min_range, cpa_max_range: Horizontal ranges of the sweep, metres.
        iou_limits: Overlaps of Table 8.
    """

    search_eps: tuple[float, ...] = (0.10, 0.15, 0.20, 0.25, 0.30, 0.35, 0.40, 0.45, 0.50, 0.55, 0.60, 0.70, 0.80)
    search_min_samples: tuple[int, ...] = (5, 10, 15, 20, 30)
    search_distance: float = 0.5
    cpa_steps: int = 8
    cpa_min_range: float = 15.0
    cpa_max_range: float = 60.0
    iou_limits: tuple[float, ...] = (0.10, 0.25)

"""The numbers of the experiments."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.param_fields import MAX_INT, Params, param


@dataclass(frozen=True)
class StmCpaParams(Params):
    """What paper A varies, Sections 4.2 and 4.5. The paper does not say which eps and min_samples
    it tried; these hold all that it speaks of."""

    search_eps: tuple[float, ...] = param(
        (0.10, 0.15, 0.20, 0.25, 0.30, 0.35, 0.40, 0.45, 0.50, 0.55, 0.60, 0.70, 0.80),
        "Values of eps in the parameter search.", unit="m", low=0.001, high=100.0)
    search_min_samples: tuple[int, ...] = param(
        (5, 10, 15, 20, 30), "Values of min_samples in the parameter search.", low=1, high=MAX_INT)
    search_distance: float = param(0.5, "A hit of the parameter search has its 3D centre within "
                                   "this distance.", unit="m", low=0.0, high=100.0)
    cpa_steps: int = param(8, "The CPA sweep goes from 0 to this number of steps.", low=0,
                           high=100)
    cpa_min_range: float = param(15.0, "Nearest horizontal range of the CPA sweep.", unit="m",
                                 low=0.0, high=1e6)
    cpa_max_range: float = param(60.0, "Farthest horizontal range of the CPA sweep.", unit="m",
                                 low=0.0, high=1e6)
    iou_limits: tuple[float, ...] = param((0.10, 0.25), "A hit counts as overlapping from these "
                                          "IoU on (Table 8).", low=0.0, high=1.0)


@dataclass(frozen=True)
class BootstrapParams(Params):
    """Intervals: frames are drawn with replacement, as many as there are."""

    replicates: int = param(2000, "Times that the frames are drawn.", low=100, high=1_000_000)
    level: float = param(0.95, "Share of the replicates inside an interval.", low=0.01, high=0.999)
    seed: int = param(0, "Seed of the draws.", low=0, high=MAX_INT)

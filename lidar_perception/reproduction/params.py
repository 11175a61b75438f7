"""The numbers of the experiments. They go into the settings of a run, which is resumed only with
identical ones."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StmCpaParams:
    """What paper A varies, Sections 4.2 and 4.5. The paper does not say which eps and min_samples
    it tried; these hold all that it speaks of.

    A hit of the parameter search has its 3D centre within search_distance, m. The CPA sweep goes
    from 0 to cpa_steps steps, at horizontal ranges from cpa_min_range to cpa_max_range, m.
    iou_limits: of Table 8.
    """

    search_eps: tuple[float, ...] = (0.10, 0.15, 0.20, 0.25, 0.30, 0.35, 0.40, 0.45, 0.50, 0.55,
                                     0.60, 0.70, 0.80)
    search_min_samples: tuple[int, ...] = (5, 10, 15, 20, 30)
    search_distance: float = 0.5
    cpa_steps: int = 8
    cpa_min_range: float = 15.0
    cpa_max_range: float = 60.0
    iou_limits: tuple[float, ...] = (0.10, 0.25)


@dataclass(frozen=True)
class BootstrapParams:
    """Intervals: frames are drawn with replacement, as many as there are, `replicates` times by the
    seed; an interval holds this share of the replicates."""

    replicates: int = 2000
    level: float = 0.95
    seed: int = 0

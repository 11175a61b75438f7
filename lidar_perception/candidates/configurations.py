"""Named configurations of the candidate pipeline."""

from __future__ import annotations

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.clustering.params import FULL_DENSITY
from lidar_perception.param_fields import with_values

# Paper A's protocol: points in the camera's view, and the nearest labelled pedestrian as seed. The
# other values in the paper are the defaults of params.py. The paper removes the ground by a height
# threshold alone (Section 3.2); this fails on slopes, so it is not the default.
PAPER_VALUES = {
    "view.enabled": True,
    "seed.source": "ground_truth",
    "ground.threshold.separate": "height",
    "boxes.plane": "ransac",
}

# With these values the pipeline found the most pedestrians, with every seed source, in frames that
# they were not tuned on; docs/how-to/evaluate.md has the results.
BEST_VALUES = {
    "ground.threshold.separate": "plane",
    "boxes.plane": "least_squares",
    "clustering.density": FULL_DENSITY,
    "clustering.dbscan.range_limits": (15.0, 30.0, 45.0),
    "clustering.dbscan.eps": (0.15, 0.30, 0.50, 0.70),
    "clustering.dbscan.min_samples": 5,
    "clustering.dbscan.join_bands": True,
    "height.tolerance": 0.6,  # only saves time, because the confidence already depends on the height
    "stm.window": "metric",
    "stm.spread": True,
    "stm.dilations": 0,
    "stm.seen_only": True,
    "stm.shifts": 2,
    "cpa.steps": 0,  # copies are not needed for points drawn with `spread`
    "confidence.enabled": True,
    "confidence.threshold": 0.25,
}
PAPER = with_values(PipelineParams(), PAPER_VALUES)
BEST = with_values(PAPER, BEST_VALUES)
CONFIGURATIONS = {"paper": PAPER_VALUES, "best": BEST_VALUES}

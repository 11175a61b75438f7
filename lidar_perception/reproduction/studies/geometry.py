"""Question 6: how a silhouette is cut out. Stretched to the cluster or a window of fixed size,
turned about z only or aligned with all principal axes."""

from lidar_perception.candidates.configurations import PAPER
from lidar_perception.param_fields import with_values
from lidar_perception.reproduction.variants import compared_variants

STUDY = compared_variants(
    "geometry", "Silhouette geometry",
    "Should the window follow the cluster or have a fixed size, and the axes the yaw alone?",
    {f"{window}, {axis}": with_values(PAPER, {"stm.window": window, "stm.axis": axis,
                                                 "stm.spread": spread})
     for spread in (False,) for window in ("stretched", "metric") for axis in ("yaw", "pca")}
    | {f"{window}, {axis}, points spread": with_values(
        PAPER, {"stm.window": window, "stm.axis": axis, "stm.spread": True, "stm.dilations": 0,
                   "cpa.steps": 0})
       for window in ("stretched", "metric") for axis in ("yaw", "pca")})

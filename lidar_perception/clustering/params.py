"""Parameters of the clustering methods and of the boxes of clusters."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.param_fields import MAX_INT, Params, param


@dataclass(frozen=True)
class DbscanParams(Params):
    """Parameters of distance-aware DBSCAN (paper A, Section 3.3, Table 2)."""

    range_limits: tuple[float, ...] = param(
        (15.0, 30.0), "Horizontal ranges at which eps changes, ascending.", unit="m", low=0.0, high=1e6
    )
    eps: tuple[float, ...] = param(
        (0.15, 0.30, 0.50),
        "Neighbourhood radius in each range band, one more value than range_limits. While a node runs, set both in one "
        "call of set_parameters_atomically.",
        unit="m",
        low=0.001,
        high=100.0,
    )
    min_samples: int = param(
        10, "Minimum number of points within eps, including the point itself, for a core point.", low=1, high=MAX_INT
    )
    join_bands: bool = param(
        False,
        "Join clusters across a range limit if points of both are within the smaller eps; the paper splits them there.",
    )

    def check(self) -> None:
        if len(self.eps) != len(self.range_limits) + 1:
            raise ValueError(
                f"eps has {len(self.eps)} values for {len(self.range_limits)} range_limits; give one more eps than "
                "range_limits (while a node runs, set both in one call of set_parameters_atomically)"
            )
        if any(b <= a for a, b in zip(self.range_limits, self.range_limits[1:])):
            raise ValueError(f"range_limits = {list(self.range_limits)} must be in ascending order")


@dataclass(frozen=True)
class EuclideanParams(Params):
    """Parameters of adaptive Euclidean clustering (paper C, Eq. 6 to 9 and 11)."""

    threshold: str = param(
        "local",
        "global: one distance for the whole cloud (Eq. 6). local: one for each point, from its neighbours (Eq. 11). "
        "fixed: `distance`.",
        choices=("global", "local", "fixed"),
    )
    distance: float = param(0.5, "Distance threshold if threshold is fixed.", unit="m", low=0.001, high=10.0)
    alpha: float = param(1.2, "Factor of the distance threshold (Eq. 6 and 11).", low=0.01, high=100.0)
    beta: float = param(
        0.5,
        "Factor of MinPts = beta ln N, the minimum number of points within the threshold, including the point itself, "
        "for a core point (Eq. 7).",
        low=0.0,
        high=1000.0,
    )
    gamma: float = param(
        0.8,
        "Clusters are merged if their centres are closer than gamma times the mean of their diameters (Eq. 9); 0: no "
        "merging.",
        low=0.0,
        high=10.0,
    )
    radius: float = param(0.5, "Radius of the neighbourhood for the local threshold.", unit="m", low=0.001, high=10.0)
    min_size: int = param(10, "Minimum number of points of a cluster.", low=1, high=MAX_INT)
    curvature: float = param(
        0.0,
        "Curvature-consistent growing: clusters grow only from core points whose surface variation (0 to 1/3) differs "
        "by at most this value from the mean within `radius`; 0: from all core points.",
        low=0.0,
        high=1.0,
    )


CLUSTERING_METHODS = ("dbscan", "euclidean")
FULL_DENSITY = 10.0  # points per square degree from which our parameter values apply; an HDL-64E has 13 to 16


@dataclass(frozen=True)
class ClusteringParams(Params):
    """Parameters of the clustering of non-ground points."""

    method: str = param(
        "dbscan",
        "dbscan: distance-aware DBSCAN (STM-CPA paper). euclidean: adaptive Euclidean clustering (improved-PointNet "
        "paper).",
        choices=CLUSTERING_METHODS,
    )
    density: float = param(
        0.0,
        "Minimum density, in points per square degree of view, at which the values below apply unchanged. For sparser "
        "clouds, neighbourhoods grow and minimum sizes shrink. 0: the values apply to every cloud.",
        low=0.0,
        high=10_000.0,
    )
    dbscan: DbscanParams = DbscanParams()
    euclidean: EuclideanParams = EuclideanParams()


BOX_SHAPES = ("axis_aligned", "min_area", "l_shape")


@dataclass(frozen=True)
class BoxParams(Params):
    """Parameters of the boxes of clusters."""

    shape: str = param(
        "axis_aligned",
        "axis_aligned: aligned with x and y (STM-CPA paper). min_area: the smallest rectangle. l_shape: aligned with "
        "the two visible sides.",
        choices=BOX_SHAPES,
    )
    plane: str = param(
        "least_squares",
        "Ground plane on which the boxes stand. least_squares: fitted to all ground points. ransac: fitted to the "
        "inliers (STM-CPA paper).",
        choices=("least_squares", "ransac"),
    )

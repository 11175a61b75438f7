"""Configuration of paper C's improved PointNet, its ablations and baselines.

Paper C (Zhang et al., PLOS One 2026, e0348581) defines the parts (Eq. 13 to 19) but does not state
layer widths; docs/explanation/papers.md lists deviations from its equations. The switches are those
of its Table 5. PointNet and PointNet++ (SSG) are configurations of the same network. Checkpoints
contain the dataclass as JSON, so weights and architecture cannot get separated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, TypedDict

from lidar_perception.classes import DETECTED
from lidar_perception.clustering.params import FULL_DENSITY, ClusteringParams, EuclideanParams
from lidar_perception.ground.params import GroundParams
from lidar_perception.types import CLASSES, InputError

MAX_POINTS = 4096  # maximum number of points per cluster, to bound computing time
SAMPLINGS, DENSITIES = ("random", "farthest"), ("neighbours", "ball")


@dataclass(frozen=True)
class PointNetConfig:
    """Architecture of a network that classifies one cluster at a time.

    Attributes:
        name: name of the variant.
        classes: classes of the scores, without the background, which is the last score.
        dynamic_threshold, log_point_count: switches of the clustering (Eq. 6, 7, 11), see
            `clustering`.
        msg: group points at all radii; otherwise, if points are grouped, only at the largest one.
        mrg: concatenate features of a coarser grouping and of single points, weighted by density
            (Eq. 15, 17).
        skip: concatenate shallow features with the deep ones (Eq. 16).
        grouped: group points. If grouped, msg and mrg are all False, points are processed one by
            one, as in PointNet.
        points: maximum number of points read from a cluster (Eq. 13).
        centroids, coarse: number of groups of points, and number of groups of their centroids.
        radii, coarse_radius: radii of the groups, metres.
        neighbours, coarse_neighbours: maximum number of members of a group.
        sampling: selection of centroids among the points. random: the first points, which are in
            random order. farthest: farthest point sampling (Eq. 15, 17).
        density: weight of the features at each radius (Eq. 17). neighbours: number of members of
            the group, at most `neighbours`, divided by the radius. ball: number of all points
            within the radius divided by the volume.
        point_channels, group_channels, local_channels, global_channels, head_channels: widths of
            the layers.
        yaw_bins: number of yaw bins of the full circle.
        sizes: reference length, width and height of each class, metres; by default the means of
            KITTI's training labels (Geiger et al. 2012).
    """

    network: ClassVar[str] = "pointnet"

    name: str = "improved"
    classes: tuple[str, ...] = tuple(DETECTED)
    dynamic_threshold: bool = True
    log_point_count: bool = True
    msg: bool = True
    mrg: bool = True
    skip: bool = True
    grouped: bool = True
    points: int = 128
    centroids: int = 32
    coarse: int = 8
    radii: tuple[float, ...] = (0.1, 0.2, 0.4)
    neighbours: tuple[int, ...] = (8, 12, 16)
    coarse_radius: float = 1.2
    coarse_neighbours: int = 8
    sampling: str = "random"
    density: str = "neighbours"
    point_channels: tuple[int, ...] = (32, 64)
    group_channels: tuple[int, ...] = (32, 32)
    local_channels: int = 128
    global_channels: int = 128
    head_channels: tuple[int, ...] = (256, 128)
    yaw_bins: int = 12
    sizes: tuple[tuple[float, float, float], ...] = tuple(properties.mean_size for properties in DETECTED.values())

    def __post_init__(self) -> None:
        numbers = (
            self.points,
            self.centroids,
            self.coarse,
            self.coarse_neighbours,
            self.yaw_bins,
            self.local_channels,
            self.global_channels,
            *self.neighbours,
            *self.point_channels,
            *self.group_channels,
            *self.head_channels,
        )
        if (
            min(numbers) < 1
            or min(self.coarse_radius, *self.radii) <= 0
            or not (self.point_channels and self.group_channels and self.head_channels)
        ):
            raise ValueError("all counts, widths and radii must be above 0")
        if unknown_names := [name for name in self.classes if name not in CLASSES]:
            raise ValueError(f"unknown class {unknown_names[0]!r}; choose from {', '.join(CLASSES)}")
        if not self.classes or len(self.sizes) != len(self.classes):
            raise ValueError("classes and sizes must have the same length, at least 1")
        if len(set(self.classes)) < len(self.classes) or min(map(min, self.sizes)) <= 0:
            raise ValueError("classes must be unique, and sizes above 0")
        if not self.radii or len(self.radii) != len(self.neighbours):
            raise ValueError("radii and neighbours must have the same length, at least 1")
        if list(self.radii) != sorted(self.radii) or max(self.neighbours) > self.points:
            raise ValueError("radii must be in ascending order, and neighbours at most points")
        if not max(self.coarse, self.coarse_neighbours) <= self.centroids <= self.points:
            raise ValueError("expected coarse <= centroids, coarse_neighbours <= centroids and centroids <= points")
        if self.sampling not in SAMPLINGS or self.density not in DENSITIES:
            raise ValueError(
                f"sampling must be one of {', '.join(SAMPLINGS)}, and density one of {', '.join(DENSITIES)}"
            )
        if self.points > MAX_POINTS:
            raise ValueError(f"points must be at most {MAX_POINTS}")

    @property
    def title(self) -> str:
        """Name of the variant in parentheses; empty for the network of the paper."""
        return "" if self.name == "improved" else f"({self.name})"

    @property
    def groups(self) -> tuple[tuple[float, int], ...]:
        """Radius and maximum number of neighbours of each scale; empty for PointNet."""
        scales = tuple(zip(self.radii, self.neighbours))
        if self.msg:
            return scales
        return scales[-1:] if self.grouped or self.mrg else ()

    @property
    def farthest_count(self) -> int:
        """Number of points selected by farthest point sampling, see make_network_input."""
        return self.centroids if self.sampling == "farthest" else 0

    @property
    def min_points(self) -> int:
        """Minimum number of points after padding, as needed to fill all groups."""
        return max(self.coarse, self.coarse_neighbours, *self.neighbours)

    @property
    def clustering(self) -> ClusteringParams:
        """Clustering parameters for this network.

        Without dynamic_threshold, the distance threshold is the same for all points. Without
        log_point_count, it does not depend on the number of neighbours.
        """
        euclidean = EuclideanParams(
            threshold="local" if self.dynamic_threshold else "fixed",
            gamma=0.0,
            beta=EuclideanParams().beta if self.log_point_count else 0.0,
        )
        return ClusteringParams(method="euclidean", density=FULL_DENSITY, euclidean=euclidean)

    @property
    def ground(self) -> GroundParams:
        return GroundParams(method="cloth")


class Switches(TypedDict, total=False):
    """Fields of PointNetConfig that differ between the networks of paper C."""

    dynamic_threshold: bool
    log_point_count: bool
    msg: bool
    mrg: bool
    skip: bool
    grouped: bool
    radii: tuple[float, ...]
    sampling: str
    density: str


PLAIN = Switches(msg=False, mrg=False, skip=False, grouped=False)
# Paper C, Table 5. If the table does not specify the clustering, the proposed one is used.
ABLATIONS: dict[str, Switches] = {
    "base": {"dynamic_threshold": False, "log_point_count": False, **PLAIN},
    "dynamic-threshold": {"log_point_count": False, **PLAIN},
    "log-point-count": {"dynamic_threshold": False, **PLAIN},
    "skip": Switches(msg=False, mrg=False, grouped=False),
    "msg-mrg": Switches(skip=False),
    "msg-skip": Switches(mrg=False),
    "mrg-skip": Switches(msg=False),
    "improved": Switches(),
}
NETWORKS: dict[str, Switches] = {
    **ABLATIONS,
    "pointnet": PLAIN,
    "pointnet2": Switches(msg=False, mrg=False, skip=False),  # PointNet++, single-scale grouping
    # Eq. 15 and 17 exactly as in the paper
    "farthest": Switches(sampling="farthest"),
    "ball-density": Switches(density="ball"),
    "farthest-ball-density": Switches(sampling="farthest", density="ball"),
    # Radii other than the paper's (0.1, 0.2, 0.4), Table 4
    "radii-halved": Switches(radii=(0.05, 0.1, 0.2)),
    "radii-doubled": Switches(radii=(0.2, 0.4, 0.8)),
    "radii-quadrupled": Switches(radii=(0.4, 0.8, 1.6)),
}


def make_pointnet_config(name: str = "improved", **changes: Any) -> PointNetConfig:
    """Make the config of a network.

    Args:
        name: key in NETWORKS.
        changes: values of other fields of PointNetConfig.

    Raises:
        InputError: the name is unknown, or the fields do not fit together.
    """
    if name not in NETWORKS:
        raise InputError(f"unknown network {name!r}; choose from {', '.join(NETWORKS)}")
    try:
        return replace(PointNetConfig(name=name, **NETWORKS[name]), **changes)
    except (ValueError, TypeError) as error:
        raise InputError(str(error)) from None

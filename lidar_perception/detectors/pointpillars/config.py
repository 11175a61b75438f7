"""Configuration of all versions and sizes of EG-PointPillars.

Paper B (Ahn, Kim, Park, CMC 2026, 87(1), 84) compares PointPillars (v0) with four versions guided
by ground segmentation and clustering. All versions are configurations of one dataclass. Checkpoints
contain the dataclass as JSON, so weights and architecture cannot get separated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, TypedDict

from lidar_perception.classes import DETECTED
from lidar_perception.types import CLASSES, SENSOR_HEIGHT, InputError

VERSIONS = {  # versions of Table 3 in paper B
    "v0": dict(remove_ground=False, cluster_ids=False, pseudo_map=False, neck="deconv"),
    "v1": dict(remove_ground=True, cluster_ids=False, pseudo_map=False, neck="fpn"),
    "v2": dict(remove_ground=True, cluster_ids=True, pseudo_map=False, neck="fpn"),
    "v3": dict(remove_ground=False, cluster_ids=True, pseudo_map=False, neck="fpn"),
    "v4": dict(remove_ground=True, cluster_ids=False, pseudo_map=True, neck="fpn"),
}
SIZES = {
    # Widths of Lang et al., CVPR 2019; the neck has 2C = 64 channels as in paper B.
    "full": dict(
        pillar_channels=64,
        map_channels=(16, 32, 64),
        block_channels=(64, 128, 256),
        block_layers=(3, 5, 5),
        deconv_channels=128,
        fpn_channels=64,
    ),
    # The same grid with an eighth of the operations, for two CPU cores.
    "compact": dict(
        pillar_channels=16,
        map_channels=(8, 8),
        block_channels=(32, 64, 96),
        block_layers=(1, 3, 3),
        deconv_channels=32,
        fpn_channels=32,
    ),
}


class Range(TypedDict):
    """Area that a network covers: two fields of NetworkConfig."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]


AHEAD = Range(low=(0.0, -39.68, -3.0), high=(69.12, 39.68, 1.0))  # region in which KITTI has labels
RANGES = {"ahead": AHEAD, "around": Range(low=(-51.2, -51.2, -3.0), high=(51.2, 51.2, 1.0))}
# Half of `around` plus a margin so that no object is cut off. A network trained for `ahead` covers
# `around` in two passes with this range.
HALF = Range(low=(-5.12, -51.2, -3.0), high=(51.2, 51.2, 1.0))

XY_SCALE = 0.02  # scale of x and y in networks trained with this package
CHOICES = {"neck": ("deconv", "fpn"), "fusion": ("add", "concat"), "anchors_at": ("cells", "ends")}
NORM_EPS = 1e-3  # epsilon of the batch norms
CODE, BINS = 7, 2  # values per box code, and direction bins (half circles)
MAX_CELLS = 1 << 22  # maximum number of grid cells, to bound computing time: about 100 m x 100 m at 5 cm
MAX_LAYERS = 64


@dataclass(frozen=True)
class AnchorClass:
    """Anchor boxes of one class.

    Attributes:
        size: length, width, height in metres.
        z: z of the centre in metres, for a sensor at SENSOR_HEIGHT.
        matched: minimum bird's-eye-view IoU of an anchor that is a positive example in training.
        unmatched: IoU below which an anchor is background.
    """

    name: str
    size: tuple[float, float, float]
    z: float
    matched: float
    unmatched: float


ANCHORS = tuple(  # all anchors stand on the ground
    AnchorClass(
        name, properties.anchor, properties.anchor[2] / 2 - SENSOR_HEIGHT, properties.matched, properties.unmatched
    )
    for name, properties in DETECTED.items()
)


@dataclass(frozen=True)
class NetworkConfig:
    """Architecture of a network. `version` and `size` name it; the other fields define it.

    Attributes:
        remove_ground: the network reads only points that are not ground.
        cluster_ids: the cluster id of a point, times id_scale, is a fifth input; 0 for ground and
            noise.
        pseudo_map: the network has a branch for the map of classified clusters.
        neck: 'deconv' (PointPillars) or 'fpn' (paper B, Eq. 1-8). The output of both has the
            resolution of the first block.
        fusion: fusion of the maps in the fpn, 'add' or 'concat'.
        low, high: corners [x y z] of the range, metres.
        cell: side length of a pillar, metres.
        xy_scale: factor of x and y before the first layer. With 1, as in the papers and in imported
            weights, x and y are 50 times larger than the other inputs, and a compact network spends
            most of its few channels on the position of the pillar, which the grid encodes anyway.
        max_points: maximum number of points read per pillar, in the order of the cloud; 0: all.
            This field and the next two exist for imported weights.
        zero_row: pillars with fewer than max_points points also have a point with all inputs 0, as
            in code that pads pillars.
        middle_z: the height above the middle of the range is an additional input of each point.
        anchors_at: 'cells' places anchors at the centres of the head's cells, 'ends' spaces them
            evenly from low to high.
        direction_offset: start of the two heading bins, radians.
    """

    network: ClassVar[str] = "pointpillars"

    version: str = "v0"
    size: str = "full"
    remove_ground: bool = False
    cluster_ids: bool = False
    pseudo_map: bool = False
    neck: str = "deconv"
    fusion: str = "add"
    low: tuple[float, float, float] = AHEAD["low"]
    high: tuple[float, float, float] = AHEAD["high"]
    cell: float = 0.16
    xy_scale: float = 1.0
    max_points: int = 0
    zero_row: bool = False
    middle_z: bool = False
    id_scale: float = 0.01
    pillar_channels: int = 64
    map_channels: tuple[int, ...] = (16, 32, 64)
    block_channels: tuple[int, ...] = (64, 128, 256)
    block_layers: tuple[int, ...] = (3, 5, 5)
    block_strides: tuple[int, ...] = (2, 2, 2)
    deconv_channels: int = 128
    fpn_channels: int = 64
    anchors: tuple[AnchorClass, ...] = ANCHORS
    yaws: tuple[float, ...] = (0.0, 1.5707963267948966)
    anchors_at: str = "cells"
    direction_offset: float = 0.7853981633974483

    def __post_init__(self) -> None:
        widths = (
            self.pillar_channels,
            self.deconv_channels,
            self.fpn_channels,
            *self.map_channels,
            *self.block_channels,
            *self.block_strides,
        )
        if not (self.map_channels and self.block_channels and self.yaws and self.anchors) or (
            min(widths) < 1
            or min(self.block_layers, default=0) < 0
            or min(min(anchor.size) for anchor in self.anchors) <= 0
            or self.max_points < 0
        ):
            raise ValueError("all widths and strides must be at least 1, and all sizes above 0")
        if sum(self.block_layers) > MAX_LAYERS:
            raise ValueError(f"the sum of block_layers must be at most {MAX_LAYERS}")
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} must be one of {', '.join(choices)}")
        if not (self.cell > 0 and all(a < b for a, b in zip(self.low, self.high))):
            raise ValueError("cell must be above 0, and low must be below high")
        height, width = self.grid
        if height * width > MAX_CELLS:
            raise ValueError(f"a grid of {width} x {height} cells has more than {MAX_CELLS} cells")
        max_stride = math.prod(self.block_strides)
        if height % max_stride or width % max_stride or height < max_stride or width < max_stride:
            raise ValueError(
                f"a grid of {width} x {height} cells cannot be divided by {max_stride}, "
                "the product of block_strides; change low, high or cell"
            )
        if not len(self.block_channels) == len(self.block_layers) == len(self.block_strides):
            raise ValueError("block_channels, block_layers and block_strides must have the same length")
        if unknown_names := [name for name in self.classes if name not in CLASSES]:
            raise ValueError(f"unknown class {unknown_names[0]!r}; choose from {', '.join(CLASSES)}")
        if len(set(self.classes)) < len(self.classes):
            raise ValueError("two anchors have the same class")
        if self.zero_row and not self.max_points:
            raise ValueError("zero_row requires max_points")

    @property
    def title(self) -> str:
        """Name of the variant, such as "v4 compact"."""
        return f"{self.version} {self.size}"

    @property
    def classes(self) -> tuple[str, ...]:
        return tuple(anchor.name for anchor in self.anchors)

    @property
    def grid(self) -> tuple[int, int]:
        """Number of cells along y and along x, (H, W)."""
        return (round((self.high[1] - self.low[1]) / self.cell), round((self.high[0] - self.low[0]) / self.cell))

    @property
    def head_grid(self) -> tuple[int, int]:
        """Size (H, W) of the head's input."""
        stride = self.block_strides[0]
        return self.grid[0] // stride, self.grid[1] // stride

    @property
    def anchors_per_cell(self) -> int:
        return len(self.anchors) * len(self.yaws)

    @property
    def point_columns(self) -> int:
        """Number of columns of Pillars.points."""
        return 5 if self.cluster_ids else 4

    @property
    def offset_columns(self) -> int:
        """Number of columns of Pillars.offsets."""
        return 6 if self.middle_z else 5


def make_config(
    version: str = "v0", size: str = "full", classes: tuple[str, ...] = tuple(DETECTED), **changes: Any
) -> NetworkConfig:
    """Make the config of a version and size.

    Args:
        classes: names of the classes to detect.
        changes: values of other fields of NetworkConfig.

    Raises:
        InputError: a name is unknown, or the fields do not fit together.
    """
    for kind, name, choices in ("version", version, VERSIONS), ("size", size, SIZES):
        if name not in choices:
            raise InputError(f"unknown {kind} {name!r}; choose from {', '.join(choices)}")
    anchors = {anchor.name: anchor for anchor in ANCHORS}
    if not classes:
        raise InputError(f"no class is given; choose from {', '.join(anchors)}")
    if unknown_names := [name for name in classes if name not in anchors]:
        raise InputError(f"no anchor for class {unknown_names[0]!r}; choose from {', '.join(anchors)}")
    settings = dict(
        version=version,
        size=size,
        xy_scale=XY_SCALE,
        anchors=tuple(anchors[name] for name in classes),
        **VERSIONS[version],
        **SIZES[size],
    )
    try:
        return NetworkConfig(**{**settings, **changes})
    except ValueError as error:
        raise InputError(str(error)) from None

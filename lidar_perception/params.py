"""Every number of this package, once.

One frozen dataclass an algorithm. From these fields come the ROS parameter declarations with
their descriptors, the check of YAML files, the command-line flags and the tables in docs/.
A value outside its range raises ValueError when the dataclass is made, with the name, the value
and the range in the message.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field, fields
from typing import Any

MAX_INT = 2**31 - 1


def param(default: Any, doc: str, *, unit: str = "", low: float | None = None,
          high: float | None = None, choices: tuple[str, ...] = (), fixed: bool = False) -> Any:
    """A dataclass field with what ROS, YAML, the command line and the docs need to know.

    low and high are inclusive; fixed parameters cannot change while a node runs. A default of
    type `type` stands for an empty list of it.
    """
    item = default if isinstance(default, type) else type(default[0]) if isinstance(
        default, tuple) else None
    default = () if isinstance(default, type) else default
    metadata = dict(doc=doc, unit=unit, low=low, high=high, choices=choices, fixed=fixed,
                    item=item)
    return field(default=default, metadata=metadata)


class Params:
    """Base of all parameter groups: checks types and ranges on construction."""

    def __post_init__(self) -> None:
        for f in fields(self):
            object.__setattr__(self, f.name, _checked(f, getattr(self, f.name)))
        self.check()

    def check(self) -> None:
        """Conditions between fields; raise ValueError."""


def _checked(f: dataclasses.Field, value: Any) -> Any:
    """value with the type of the field's default, or ValueError naming field, value and range."""
    default, limits = f.default, f.metadata
    if isinstance(default, tuple):
        if isinstance(value, str) or not hasattr(value, "__iter__"):
            raise ValueError(f"{f.name} = {value!r} must be a list of {limits['item'].__name__}")
        return tuple(_scalar(f, limits["item"], item) for item in value)
    value = _scalar(f, type(default), value)
    if limits["choices"] and value not in limits["choices"]:
        raise ValueError(f"{f.name} = {value!r} must be one of {', '.join(limits['choices'])}")
    return value


def _scalar(f: dataclasses.Field, kind: type, value: Any) -> Any:
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value) if abs(value) < 2**63 else math.copysign(math.inf, value)
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise ValueError(f"{f.name} = {value!r} must be of type {kind.__name__}")
    low, high = f.metadata["low"], f.metadata["high"]
    if kind is float and math.isnan(value):
        raise ValueError(f"{f.name} is not a number (NaN)")
    if (low is not None and value < low) or (high is not None and value > high):
        bounds = f"{'-inf' if low is None else low} .. {'inf' if high is None else high}"
        unit = f" {f.metadata['unit']}" if f.metadata["unit"] else ""
        raise ValueError(f"{f.name} = {value} is outside {bounds}{unit}")
    return value


@dataclass(frozen=True)
class ViewParams(Params):
    """Crop to the camera's field of view (paper A, Section 3.2)."""

    enabled: bool = param(
        False, "Keep only the points that the camera sees. Needs the camera's calibration: "
        "CameraInfo and the transform from the LiDAR, both latched.")


@dataclass(frozen=True)
class GroundParams(Params):
    """z threshold and RANSAC plane (paper A, Sections 3.2 and 3.4, Table 2)."""

    z_max: float = param(-1.3, "Only points below this height can be ground.", unit="m",
                         low=-100.0, high=100.0)
    inlier_distance: float = param(0.1, "A point this near the plane, vertically, is ground.",
                                   unit="m", low=0.001, high=2.0)
    max_iterations: int = param(2000, "RANSAC trials at most; it stops as soon as another trial "
                                "would hardly help.", low=1, high=100_000)
    max_slope: float = param(30.0, "Planes steeper than this are not ground.", unit="deg",
                             low=0.0, high=89.0)
    seed: int = param(0, "Seed of the random trials.", low=0, high=MAX_INT)


@dataclass(frozen=True)
class DbscanParams(Params):
    """Distance-aware DBSCAN (paper A, Section 3.3, Table 2)."""

    range_limits: tuple[float, ...] = param(
        (15.0, 30.0), "Horizontal ranges at which eps changes, ascending.", unit="m",
        low=0.0, high=1e6)
    eps: tuple[float, ...] = param(
        (0.15, 0.30, 0.50), "Neighbourhood radius in each range band, one more than range_limits.",
        unit="m", low=0.001, high=100.0)
    min_samples: int = param(10, "Points within eps, itself included, that make a core point.",
                             low=1, high=MAX_INT)

    def check(self) -> None:
        if len(self.eps) != len(self.range_limits) + 1:
            raise ValueError(f"eps has {len(self.eps)} values for {len(self.range_limits)} "
                             "range_limits; give one more eps than range_limits")
        if any(b <= a for a, b in zip(self.range_limits, self.range_limits[1:])):
            raise ValueError(f"range_limits = {list(self.range_limits)} must ascend")


@dataclass(frozen=True)
class HeightParams(Params):
    """Height filter (paper A, Section 3.5)."""

    tolerance: float = param(0.2, "A candidate's height may differ this much from the seed's.",
                             unit="m", low=0.0, high=100.0)


@dataclass(frozen=True)
class StmParams(Params):
    """Single template matching (paper A, Section 3.6)."""

    threshold: float = param(0.40, "Cosine similarity with the seed's silhouette from which a "
                             "cluster is accepted.", low=0.0, high=1.0)


@dataclass(frozen=True)
class CpaParams(Params):
    """Centralized point augmentation (paper A, Section 3.7)."""

    min_range: float = param(15.0, "Nearest horizontal range where points are added.", unit="m",
                             low=0.0, high=1e6)
    max_range: float = param(30.0, "Farthest horizontal range where points are added.", unit="m",
                             low=0.0, high=1e6)
    steps: int = param(2, "Contracted copies of the cluster that are added; 0 adds none.",
                       low=0, high=100)
    decrement: float = param(0.10, "Scale lost with each copy.", low=0.0, high=1.0)
    min_scale: float = param(0.20, "Smallest scale of a copy.", low=0.0, high=1.0)


SEED_SOURCES = ("ground_truth", "click", "file")


@dataclass(frozen=True)
class SeedParams(Params):
    """Where the seed pedestrian comes from (paper A, Section 3.5)."""

    source: str = param(
        "file", "ground_truth: nearest Pedestrian of the frame's labels (the paper's protocol). "
        "click: the cluster at /clicked_point. file: a saved template.", choices=SEED_SOURCES)
    file: str = param("", "Template file for source 'file'; empty: the one that comes with the "
                      "package.")
    click_radius: float = param(2.0, "A click takes the nearest cluster within this distance.",
                                unit="m", low=0.01, high=100.0)


# The steps of the candidate pipeline whose times are taken, in order.
STEPS = ("view", "ground", "clustering", "boxes", "height", "stm", "cpa")


@dataclass(frozen=True)
class PipelineParams:
    """All groups of the candidate pipeline, in the order of the stages."""

    view: ViewParams = ViewParams()
    ground: GroundParams = GroundParams()
    dbscan: DbscanParams = DbscanParams()
    height: HeightParams = HeightParams()
    stm: StmParams = StmParams()
    cpa: CpaParams = CpaParams()
    seed: SeedParams = SeedParams()


# Each node declares the groups of its own stages, under the same names.


@dataclass(frozen=True)
class GroundNodeParams:
    view: ViewParams = ViewParams()
    ground: GroundParams = GroundParams()


@dataclass(frozen=True)
class ClusteringNodeParams:
    dbscan: DbscanParams = DbscanParams()


@dataclass(frozen=True)
class RefinementNodeParams:
    height: HeightParams = HeightParams()
    stm: StmParams = StmParams()
    cpa: CpaParams = CpaParams()
    seed: SeedParams = SeedParams()


@dataclass(frozen=True)
class PlayerParams(Params):
    """Replay of a rosbag2 bag."""

    bag: str = param("", "Folder of the bag, or one .mcap or .db3 file.", fixed=True)
    rate: float = param(1.0, "Speed of the replay; 2.0 is twice as fast as recorded.",
                        low=0.01, high=100.0)
    loop: bool = param(False, "Start again at the end.")
    start_offset: float = param(0.0, "Skip this much of the bag. Latched topics are replayed "
                                "all the same.", unit="s", low=0.0, fixed=True)
    duration: float = param(0.0, "Play this much of the bag; 0 plays all.", unit="s", low=0.0,
                            fixed=True)
    start_paused: bool = param(False, "Wait for ~/resume or ~/step before the first message.",
                               fixed=True)
    topics: tuple[str, ...] = param(str, "Topics to play; empty plays all.", fixed=True)
    remap: tuple[str, ...] = param(str, "Topics to rename, each as OLD:=NEW.", fixed=True)
    clock_hz: float = param(0.0, "Publish the bag's time on /clock this often; 0 does not.",
                            unit="Hz", low=0.0, high=1000.0, fixed=True)
    wait_for: tuple[str, ...] = param(
        ("/points",), "Topics that must have a subscriber before the first message, or several: "
        "TOPIC:=COUNT. Topics of other nodes may be named too.", fixed=True)
    wait_timeout: float = param(10.0, "Play without subscribers after this time; 0 does not wait.",
                                unit="s", low=0.0, high=3600.0, fixed=True)


@dataclass(frozen=True)
class RecorderParams(Params):
    """Recording of topics to a rosbag2 bag."""

    bag: str = param("", "Folder to make for the bag.", fixed=True)
    topics: tuple[str, ...] = param(str, "Topics to record.", fixed=True)


@dataclass(frozen=True)
class EvaluatorParams(Params):
    """Scores of detections against ground truth."""

    stages: tuple[str, ...] = param(("final",), "Inputs to score; each NAME is the topic "
                                    "~/input/NAME.", fixed=True)
    timing: tuple[str, ...] = param(str, "Topics with times in ms (std_msgs/Float64) to take the "
                                    "median of.", fixed=True)
    file: str = param("", "Write the scores to this JSON file at the end and every few seconds; "
                      "empty writes none.", fixed=True)
    only_with_pedestrians: bool = param(True, "Score only frames with a Pedestrian in the ground "
                                        "truth (paper A's protocol).")


def _groups(params: Any) -> dict[str, Params]:
    """'dbscan.' -> DbscanParams(...); a single group has the prefix ''."""
    if isinstance(params, Params):
        return {"": params}
    return {f"{group.name}.": getattr(params, group.name) for group in fields(params)}


def flatten(params: Any) -> dict[str, Any]:
    """{'dbscan.eps': (0.15, 0.3, 0.5), ...} of one group or a dataclass of groups."""
    return {prefix + f.name: getattr(group, f.name)
            for prefix, group in _groups(params).items() for f in fields(group)}


def parameter_fields(params: Any) -> dict[str, dataclasses.Field]:
    """{'dbscan.eps': Field, ...}: defaults and metadata under the same names as flatten."""
    return {prefix + f.name: f for prefix, group in _groups(params).items() for f in fields(group)}


def with_values(params: Any, values: dict[str, Any]) -> Any:
    """params with {'dbscan.min_samples': 5, ...} set; ValueError names what is unknown or wrong."""
    known = parameter_fields(params)
    if unknown := [name for name in values if name not in known]:
        raise ValueError(f"unknown parameter {unknown[0]!r}; known are {', '.join(known)}")
    changed = {}
    for prefix, group in _groups(params).items():
        inner = {k.removeprefix(prefix): v for k, v in values.items()
                 if known[k] in fields(group)}
        try:
            changed[prefix[:-1]] = dataclasses.replace(group, **inner)
        except ValueError as error:
            raise ValueError(f"{prefix}{error}") from None
    return changed[""] if "" in changed else dataclasses.replace(params, **changed)

"""Import of PointPillars weights from OpenPCDet and mmdetection3d (1.x).

Both projects store the same network under other names. These differences are converted exactly:

- Points have a tenth input, the height above the middle of the range (middle_z of the config).
  mmdetection3d replaces x, y and z by x_p, y_p and z_p; the weights of both are added.
- A pillar keeps its first 32 points and is padded with zeros, which take part in the maximum
  (max_points and zero_row of the config).
- OpenPCDet spreads anchors from edge to edge, mmdetection3d places them at the centres of cells.
  The origin of the two heading bins and the height of anchors differ too. In mmdetection3d the z of
  a box is that of its bottom, but codes are relative to centres, as here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lidar_perception.detectors.pointpillars.config import ANCHORS, AnchorClass, NetworkConfig, make_config
from lidar_perception.detectors.pointpillars.network import PointPillars, make_network
from lidar_perception.types import InputError

NORM_PARTS = ("weight", "bias", "running_mean", "running_var")
MAX_POINTS = 32
COLUMNS = 10  # number of inputs: x y z i, x_c y_c z_c, x_p y_p z_p


@dataclass(frozen=True)
class Project:
    """Names and conventions of the PointPillars of one project."""

    name: str
    points: str  # prefix of the linear layer for points and its norm
    block: str  # prefix of block {i}
    first: int  # index of the first convolution in a block
    neck: str  # prefix of branch {i} of the neck
    head: tuple[str, str, str]
    classes: tuple[str, ...]
    bottoms: dict[str, float]  # class -> z of the bottom face of its anchors
    anchors_at: str
    direction_offset: float
    centred_xyz: bool  # True if inputs are x_p y_p z_p instead of x y z


PROJECTS = (
    Project(
        "OpenPCDet",
        "vfe.pfn_layers.0.",
        "backbone_2d.blocks.{i}.",
        1,
        "backbone_2d.deblocks.{i}.",
        ("dense_head.conv_cls", "dense_head.conv_box", "dense_head.conv_dir_cls"),
        ("Car", "Pedestrian", "Cyclist"),
        dict(Car=-1.78, Pedestrian=-0.6, Cyclist=-0.6),
        "ends",
        0.78539,
        False,
    ),
    Project(
        "mmdetection3d",
        "voxel_encoder.pfn_layers.0.",
        "backbone.blocks.{i}.",
        0,
        "neck.deblocks.{i}.",
        ("bbox_head.conv_cls", "bbox_head.conv_reg", "bbox_head.conv_dir_cls"),
        ("Pedestrian", "Cyclist", "Car"),
        dict(Car=-1.78, Pedestrian=-0.6, Cyclist=-0.6),
        "cells",
        -math.pi / 2,
        True,
    ),
)


def import_weights(path: str | Path, classes: tuple[str, ...] = ()) -> tuple[NetworkConfig, PointPillars, str]:
    """Import a .pth file of a network with KITTI's range and 0.16 m pillars.

    Args:
        classes: names of the classes in the order of training; empty: the classes of the project.

    Returns:
        Config, network (v0 full), and name of the project.

    Raises:
        InputError: the file contains another network; the message names the first part that
            differs.
    """
    path = Path(path)
    state = _load_state(path)
    project = next((p for p in PROJECTS if f"{p.points}linear.weight" in state), None)
    if project is None:
        raise InputError(
            f"{path} is no PointPillars of {' or '.join(p.name for p in PROJECTS)}: "
            f"it has no tensor {PROJECTS[0].points}linear.weight"
        )
    config = _make_config(project, _count_anchors(state, project, path), classes, path)
    network = make_network(config)
    used_tensors, converted = {}, network.state_dict()
    for ours, theirs in _map_names(project, config).items():
        if theirs.endswith("num_batches_tracked") and theirs not in state:
            continue  # not in files of torch before 0.4.1
        used_tensors[theirs] = _get_tensor(state, theirs, path)
        converted[ours] = used_tensors[theirs]
    linear = f"{project.points}linear.weight"
    used_tensors[linear] = _get_tensor(state, linear, path)
    converted["pillar_net.linear.weight"] = _convert_inputs(used_tensors[linear], project, path)
    for name, value in network.state_dict().items():
        if converted[name].shape != value.shape:
            raise InputError(
                f"{path}: {name} has the shape {tuple(converted[name].shape)}, PointPillars needs {tuple(value.shape)}"
            )
    unused = [name for name in state if name not in used_tensors and state[name].is_floating_point()]
    if unused:
        raise InputError(
            f"{path} has {unused[0]} and {len(unused) - 1} more tensors that PointPillars "
            "does not have; it is another network"
        )
    network.load_state_dict(converted)
    return config, network, project.name


def _load_state(path: Path) -> dict[str, Tensor]:
    """Load the tensors of a .pth file without running any code in it."""
    if not path.is_file():
        raise InputError(f"file not found: {path}")
    try:
        content: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many types for damaged files
        raise InputError(
            f"{path} cannot be read as weights only: "
            f"{str(error).splitlines()[0] if str(error) else type(error).__name__}; "
            "save only its state_dict with torch.save and use that file"
        ) from None
    for key in "model_state", "state_dict":
        if isinstance(content, dict) and isinstance(content.get(key), dict):
            content = content[key]
    state = (
        {str(name).removeprefix("module."): value for name, value in content.items() if isinstance(value, Tensor)}
        if isinstance(content, dict)
        else {}
    )
    if not state:
        raise InputError(f"{path} holds no state_dict")
    return state


def _get_tensor(state: dict[str, Tensor], name: str, path: Path) -> Tensor:
    if name not in state:
        raise InputError(f"{path} has no tensor {name}; it is another network")
    return state[name].float() if state[name].is_floating_point() else state[name]


def _count_anchors(state: dict[str, Tensor], project: Project, path: Path) -> int:
    """Return the number of anchors per cell; each has seven outputs."""
    outputs = len(_get_tensor(state, f"{project.head[1]}.weight", path))
    if outputs % 14:
        raise InputError(
            f"{path}: {project.head[1]} has {outputs} outputs, which is not 7 for each class and two headings"
        )
    return outputs // 7


def _make_config(project: Project, per_cell: int, classes: tuple[str, ...], path: Path) -> NetworkConfig:
    names = classes or project.classes
    if not classes and per_cell == 2:
        names = ("Car",)
    if per_cell != 2 * len(names):
        raise InputError(
            f"{path} has {per_cell} anchors per cell, so {per_cell // 2} classes; "
            f"name them in the order of training instead of {', '.join(names)}"
        )
    anchor_by_name = {anchor.name: anchor for anchor in ANCHORS}
    if unknown := [name for name in names if name not in anchor_by_name]:
        raise InputError(f"there is no anchor for {unknown[0]!r}; choose from {', '.join(anchor_by_name)}")
    anchors = tuple(
        AnchorClass(
            name,
            anchor_by_name[name].size,
            project.bottoms[name] + anchor_by_name[name].size[2] / 2,
            anchor_by_name[name].matched,
            anchor_by_name[name].unmatched,
        )
        for name in names
    )
    return make_config(
        "v0",
        "full",
        xy_scale=1.0,
        anchors=anchors,
        max_points=MAX_POINTS,
        zero_row=True,
        middle_z=True,
        yaws=(0.0, 1.57),
        anchors_at=project.anchors_at,
        direction_offset=project.direction_offset,
    )


def _map_names(project: Project, config: NetworkConfig) -> dict[str, str]:
    """Map tensor names of this package to those of the project, except the linear layer of points."""
    names = {f"pillar_net.norm.{part}": f"{project.points}norm.{part}" for part in (*NORM_PARTS, "num_batches_tracked")}

    def add_layer(ours: str, theirs: str, index: int) -> None:
        names[f"{ours}.0.weight"] = f"{theirs}{index}.weight"
        for part in (*NORM_PARTS, "num_batches_tracked"):
            names[f"{ours}.1.{part}"] = f"{theirs}{index + 1}.{part}"

    for i, layers in enumerate(config.block_layers):
        for j in range(layers + 1):  # each layer is a convolution, a norm and a ReLU
            add_layer(f"blocks.{i}.{j}", project.block.format(i=i), project.first + 3 * j)
        add_layer(f"neck.ups.{i}", project.neck.format(i=i), 0)
    for ours, theirs in zip(("scores", "codes", "directions"), project.head):
        for part in ("weight", "bias"):
            names[f"head.{ours}.{part}"] = f"{theirs}.{part}"
    return names


def _convert_inputs(weight: Tensor, project: Project, path: Path) -> Tensor:
    """Convert weights (C, 10) to the inputs of this package."""
    if weight.shape[1] != COLUMNS:
        hint = " Weights of mmdetection3d 0.x have 9, and another order of box numbers." if project.centred_xyz else ""
        raise InputError(
            f"{path}: the points have {weight.shape[1]} inputs; supported are "
            f"{COLUMNS}: x y z intensity and the offsets from mean and middle.{hint}"
        )
    if project.centred_xyz:
        weight = weight.clone()
        weight[:, 7:10] += weight[:, 0:3]
        weight[:, 0:3] = 0
    return weight

"""Import of PointPillars weights from OpenPCDet and mmdetection3d (1.x).

Both projects use the same network with different names. These differences are converted exactly:

- Points have a tenth input, the height above the middle of the range (middle_z of the config).
  mmdetection3d replaces x, y and z by x_p, y_p and z_p; the weights of both are added.
- A pillar keeps its first 32 points and is padded with zeros, which affect the maximum (max_points
  and zero_row of the config).
- OpenPCDet spaces anchors evenly from edge to edge, mmdetection3d places them at the centres of
  cells. The origin of the two heading bins and the height of the anchors also differ. In
  mmdetection3d, z of a box refers to its bottom, but codes are relative to centres, as here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lidar_perception.detectors.pointpillars.config import NetworkConfig, make_config
from lidar_perception.detectors.pointpillars.network import PointPillars, make_network
from lidar_perception.types import InputError

NORM_PARTS = ("weight", "bias", "running_mean", "running_var")
MAX_POINTS = 32
COLUMNS = 10  # number of inputs: x y z i, x_c y_c z_c, x_p y_p z_p


@dataclass(frozen=True)
class Project:
    """Names and conventions of one project's PointPillars.

    Attributes:
        points: prefix of the linear layer for points, and of its norm.
        block: prefix of block {i}.
        first_conv: index of the first convolution in a block.
        neck: prefix of branch {i} of the neck.
        head: names of the layers for scores, codes and directions.
        classes: default classes in the order of training.
        bottoms: z of the bottom of the anchors, by class.
        anchors_at, direction_offset: see NetworkConfig.
        has_centred_xyz: True if the inputs are x_p y_p z_p instead of x y z.
    """

    name: str
    points: str
    block: str
    first_conv: int
    neck: str
    head: tuple[str, str, str]
    classes: tuple[str, ...]
    bottoms: dict[str, float]
    anchors_at: str
    direction_offset: float
    has_centred_xyz: bool


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
        classes: names of the classes in the order of training; empty: the default classes of the
            project.

    Returns:
        Config, network (v0 full), and name of the project.

    Raises:
        InputError: the file contains a different network; the message names the first difference.
    """
    path = Path(path)
    state = _load_state(path)
    project = next((p for p in PROJECTS if f"{p.points}linear.weight" in state), None)
    if project is None:
        raise InputError(
            f"{path} is not a PointPillars of {' or '.join(p.name for p in PROJECTS)}: "
            f"it has no tensor {PROJECTS[0].points}linear.weight"
        )
    config = _make_config(project, _count_anchors(state, project, path), classes, path)
    network = make_network(config)
    used_tensors, new_state = {}, network.state_dict()
    for own_name, project_name in _map_names(project, config).items():
        if project_name.endswith("num_batches_tracked") and project_name not in state:
            continue  # not in files of torch before 0.4.1
        used_tensors[project_name] = _get_tensor(state, project_name, path)
        new_state[own_name] = used_tensors[project_name]
    linear_name = f"{project.points}linear.weight"
    used_tensors[linear_name] = _get_tensor(state, linear_name, path)
    new_state["pillar_net.linear.weight"] = _convert_inputs(used_tensors[linear_name], project, path)
    for name, value in network.state_dict().items():
        if new_state[name].shape != value.shape:
            raise InputError(f"{path}: {name} has shape {tuple(new_state[name].shape)}, expected {tuple(value.shape)}")
    unused_names = [name for name in state if name not in used_tensors and state[name].is_floating_point()]
    if unused_names:
        raise InputError(
            f"{path} contains a different network: {unused_names[0]} and {len(unused_names) - 1} more tensors are not "
            "part of PointPillars"
        )
    network.load_state_dict(new_state)
    return config, network, project.name


def _load_state(path: Path) -> dict[str, Tensor]:
    """Load the tensors of a .pth file without running any code in it."""
    if not path.is_file():
        raise InputError(f"file not found: {path}")
    try:
        content: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many types of exceptions for damaged files
        raise InputError(
            f"torch.load cannot read {path} with weights_only=True: "
            f"{str(error).splitlines()[0] if str(error) else type(error).__name__}; "
            "save only the state_dict with torch.save and import that file"
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
        raise InputError(f"{path} contains no state_dict")
    return state


def _get_tensor(state: dict[str, Tensor], name: str, path: Path) -> Tensor:
    if name not in state:
        raise InputError(f"{path} contains a different network: it has no tensor {name}")
    return state[name].float() if state[name].is_floating_point() else state[name]


def _count_anchors(state: dict[str, Tensor], project: Project, path: Path) -> int:
    """Return the number of anchors per cell."""
    outputs = len(_get_tensor(state, f"{project.head[1]}.weight", path))
    if outputs % 14:
        raise InputError(
            f"{path}: {project.head[1]} has {outputs} outputs, expected a multiple of 14 (7 for each class and heading)"
        )
    return outputs // 7


def _make_config(project: Project, per_cell: int, classes: tuple[str, ...], path: Path) -> NetworkConfig:
    names = classes or project.classes
    if not classes and per_cell == 2:
        names = ("Car",)
    if per_cell != 2 * len(names):
        raise InputError(
            f"{path} has {per_cell} anchors per cell and therefore {per_cell // 2} classes, not {', '.join(names)}; "
            "name the classes in the order of training"
        )
    config = make_config(
        "v0",
        "full",
        names,
        xy_scale=1.0,
        max_points=MAX_POINTS,
        zero_row=True,
        middle_z=True,
        yaws=(0.0, 1.57),
        anchors_at=project.anchors_at,
        direction_offset=project.direction_offset,
    )
    anchors = (replace(anchor, z=project.bottoms[anchor.name] + anchor.size[2] / 2) for anchor in config.anchors)
    return replace(config, anchors=tuple(anchors))


def _map_names(project: Project, config: NetworkConfig) -> dict[str, str]:
    """Map tensor names of this package to those of the project, except the weight of the linear layer."""
    names = {f"pillar_net.norm.{part}": f"{project.points}norm.{part}" for part in (*NORM_PARTS, "num_batches_tracked")}

    def add_layer(own_prefix: str, project_prefix: str, index: int) -> None:
        names[f"{own_prefix}.0.weight"] = f"{project_prefix}{index}.weight"
        for part in (*NORM_PARTS, "num_batches_tracked"):
            names[f"{own_prefix}.1.{part}"] = f"{project_prefix}{index + 1}.{part}"

    for i, layers in enumerate(config.block_layers):
        for j in range(layers + 1):  # each layer is a convolution, a norm and a ReLU
            add_layer(f"blocks.{i}.{j}", project.block.format(i=i), project.first_conv + 3 * j)
        add_layer(f"neck.ups.{i}", project.neck.format(i=i), 0)
    for own_name, project_name in zip(("scores", "codes", "directions"), project.head):
        for part in ("weight", "bias"):
            names[f"head.{own_name}.{part}"] = f"{project_name}.{part}"
    return names


def _convert_inputs(weight: Tensor, project: Project, path: Path) -> Tensor:
    """Convert weights (C, 10) of the linear layer to the inputs of this package."""
    if weight.shape[1] != COLUMNS:
        hint = "; weights of mmdetection3d 0.x have 9 and a different box format" if project.has_centred_xyz else ""
        raise InputError(
            f"{path}: points have {weight.shape[1]} inputs, but only {COLUMNS} are supported (x y z intensity and the "
            f"offsets from the pillar's mean and centre){hint}"
        )
    if project.has_centred_xyz:
        weight = weight.clone()
        weight[:, 7:10] += weight[:, 0:3]
        weight[:, 0:3] = 0
    return weight

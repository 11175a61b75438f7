"""ONNX export of PointPillars, and inference with ONNX Runtime.

The inputs of the graph are points that are already assigned to pillars; its outputs are those of
the head. Pillars and boxes are computed outside the graph. The graph uses ScatterElements with
reduction max (opset 18), which some runtimes do not support.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.onnx_file import open_session, run_session, write_onnx
from lidar_perception.detectors.pointpillars.config import BINS, CODE, NetworkConfig
from lidar_perception.detectors.pointpillars.network import PointPillars, fuse_norms
from lidar_perception.detectors.pointpillars.pillars import Pillars
from lidar_perception.detectors.pointpillars.prediction import Prediction
from lidar_perception.types import InputError

EXAMPLE_POINTS = 100  # number of points in the example input
OUTPUTS = ["logits", "codes", "directions"]


class SingleCloudNetwork(nn.Module):
    """The network for a single cloud, with tensors as inputs and outputs."""

    def __init__(self, network: PointPillars, grid: tuple[int, int]):
        super().__init__()
        self.network, self.grid = network, grid

    def forward(
        self, points: Tensor, offsets: Tensor, cells: Tensor, cluster_map: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        return tuple(self.network(Pillars(points, offsets, cells, 1, self.grid), cluster_map))


def _describe_inputs(config: NetworkConfig) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Return the type and shape of each input for EXAMPLE_POINTS points."""
    inputs: dict[str, tuple[str, tuple[int, ...]]] = {
        "points": ("float", (EXAMPLE_POINTS, config.point_columns)),
        "offsets": ("float", (EXAMPLE_POINTS, config.offset_columns)),
        "cells": ("int64", (EXAMPLE_POINTS,)),
    }
    if config.pseudo_map:
        inputs["cluster_map"] = ("uint8", (1, 3, *config.grid))
    return inputs


def export_onnx(network: PointPillars, header: Header, path: str | Path) -> None:
    """Export a network to ONNX, for one cloud per call, with its header as metadata.

    Inputs are points (N, 4 or 5), offsets (N, 5 or 6) float32 and cells (N,) int64 as in
    pillars.Pillars, and for V4 cluster_map (1, 3, H, W) uint8. Outputs are logits (1, A, K), codes
    (1, A, 7) and directions (1, A, 2).

    Raises:
        InputError: onnx or onnxscript is not installed.
    """
    config = header.config
    inputs = {
        name: torch.zeros(shape, dtype=getattr(torch, type_name))
        for name, (type_name, shape) in _describe_inputs(config).items()
    }
    inputs["cells"] += torch.arange(EXAMPLE_POINTS)
    dynamic = {
        name: None if name == "cluster_map" else {0: torch.export.Dim("points_in_range", min=1)} for name in inputs
    }
    write_onnx(path, SingleCloudNetwork(fuse_norms(network), config.grid).eval(), header, inputs, OUTPUTS, dynamic)


class OnnxNetwork:
    """An exported network in ONNX Runtime, on the CPU."""

    has_fixed_range = True

    def __init__(self, session: Any, source: str, config: NetworkConfig):
        self.session, self.source = session, source
        self.inputs = [i.name for i in session.get_inputs()]
        anchors = math.prod(config.head_grid) * config.anchors_per_cell
        self.shapes = [(1, anchors, width) for width in (len(config.anchors), CODE, BINS)]

    @staticmethod
    def load(path: str | Path) -> tuple[Header, OnnxNetwork]:
        """Load the header and the network of an exported file.

        Raises:
            InputError: onnxruntime is not installed, or the file is missing or invalid.
        """
        session, text = open_session(path)
        header = Header.from_json(text, str(path), NetworkConfig)
        expected = {
            name: (f"tensor({type_name})", len(shape))
            for name, (type_name, shape) in _describe_inputs(header.config).items()
        }
        actual = {i.name: (i.type, len(i.shape)) for i in session.get_inputs()}
        if actual != expected or not {*OUTPUTS} <= {o.name for o in session.get_outputs()}:
            raise InputError(f"the inputs or outputs of {path} do not match its header; export it again")
        return header, OnnxNetwork(session, str(path), header.config)

    def to(self, device: str) -> None:
        """Do nothing: the network stays on the CPU."""

    def __call__(self, pillars: Pillars[np.ndarray], maps: np.ndarray | None) -> Prediction:
        arrays = dict(points=pillars.points, offsets=pillars.offsets, cells=pillars.cells, cluster_map=maps)
        logits, codes, directions = run_session(
            self.session,
            self.source,
            OUTPUTS,
            {name: value for name, value in arrays.items() if name in self.inputs and value is not None},
        )
        if [x.shape for x in (logits, codes, directions)] != self.shapes:
            raise InputError(f"the shapes of the outputs of {self.source} do not match its header; export it again")
        return Prediction(logits[0], lambda anchors: (codes[0, anchors], directions[0, anchors]))

"""ONNX export of PointNet, and inference with ONNX Runtime.

The inputs of the graph are those of ClusterInput; its outputs are box_head.Outputs, with calibrated
logits. Clusters and boxes are computed outside the graph.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.onnx_file import open_session, run_session, write_onnx
from lidar_perception.detectors.pointnet.box_head import Outputs
from lidar_perception.detectors.pointnet.clusters import CONTEXT, POINT, ClusterInput
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.detectors.pointnet.network import PointNet, fuse_norms
from lidar_perception.types import InputError

INPUTS = ("points", "valid", "context")
EXAMPLE_CLUSTERS = 4  # number of clusters in the example input


class CalibratedPointNet(nn.Module):
    """The network with calibrated logits and a tuple as output."""

    def __init__(self, network: PointNet):
        super().__init__()
        self.network = network

    def forward(self, points: Tensor, valid: Tensor, context: Tensor) -> tuple[Tensor, ...]:
        outputs = self.network(points, valid, context)
        logits = outputs.logits / self.network.temperature + self.network.offsets
        return (logits, *outputs[1:])


def export_onnx(network: PointNet, header: Header, path: str | Path) -> None:
    """Export a network to ONNX, with its header as metadata.

    Inputs are points (K, N, 5) float32, valid (K, N) bool and context (K, 6) float32 as in
    ClusterInput, where N = config.points and K may vary.

    Raises:
        InputError: onnx or onnxscript is not installed.
    """
    count = header.config.points
    inputs = {
        "points": torch.randn(EXAMPLE_CLUSTERS, count, POINT),
        "valid": torch.ones(EXAMPLE_CLUSTERS, count, dtype=torch.bool),
        "context": torch.zeros(EXAMPLE_CLUSTERS, CONTEXT),
    }
    clusters = torch.export.Dim("clusters", min=1)
    write_onnx(
        path,
        CalibratedPointNet(fuse_norms(network)).eval(),
        header,
        inputs,
        Outputs._fields,
        {name: {0: clusters} for name in inputs},
    )


class OnnxPointNet:
    """Exported network in ONNX Runtime on the CPU, with the interface of predict.Network."""

    def __init__(self, path: str | Path):
        """Open an exported network; raise InputError if it cannot be used, see open_session."""
        self.session, text = open_session(path)
        self.source = str(path)
        self.header = Header.from_json(text, self.source, PointNetConfig)
        self.config: PointNetConfig = self.header.config
        names = ({i.name for i in self.session.get_inputs()}, {o.name for o in self.session.get_outputs()})
        if names != ({*INPUTS}, {*Outputs._fields}):
            raise InputError(f"the inputs or outputs of {path} do not match its header; export it again")
        self.temperature = np.ones(1, np.float32)  # 1 because the graph already returns calibrated logits
        self.offsets = np.zeros(len(self.config.classes) + 1, np.float32)

    def to(self, device: str) -> None:
        """Do nothing: the network stays on the CPU."""

    def __call__(self, inputs: ClusterInput) -> Outputs[np.ndarray]:
        """Return the outputs for K clusters; K must be at least 1."""
        return Outputs(
            *run_session(self.session, self.source, Outputs._fields, {name: getattr(inputs, name) for name in INPUTS})
        )

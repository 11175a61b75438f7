"""PointNet in torch, in inference mode."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lidar_perception.detectors.devices import CPU
from lidar_perception.detectors.layer_weights import to_arrays
from lidar_perception.detectors.matrix_kernel import LANES
from lidar_perception.detectors.pointnet.box_head import Outputs
from lidar_perception.detectors.pointnet.clusters import ClusterInput
from lidar_perception.detectors.pointnet.compiled import CompiledPointNet
from lidar_perception.detectors.pointnet.network import PointNet
from lidar_perception.runs.threads import set_torch_threads

CHUNK = 256  # maximum clusters per batch, which limits memory and fits the cache


class TorchPointNet:
    """A PointNet in torch, in eval mode.

    Args:
        engine: implementation on the CPU: torch, or auto for compiled kernels if the CPU has AVX2.
    """

    def __init__(self, network: PointNet, engine: str = "torch"):
        set_torch_threads()
        self.network, self.config = network, network.config
        self.temperature, self.offsets = (
            values.detach().cpu().numpy() for values in (network.temperature, network.offsets)
        )
        self.compiled = CompiledPointNet(network.config, to_arrays(network)) if (LANES and engine == "auto") else None

    def to(self, device: str) -> None:
        self.network.to(device)

    def __call__(self, inputs: ClusterInput) -> Outputs[np.ndarray]:
        if self.compiled and self.network.temperature.device.type == CPU:
            return self.compiled(inputs)
        return Outputs(*(values.float().cpu().numpy() for values in run_network(self.network, inputs)))


@torch.inference_mode()
def run_network(network: PointNet, inputs: ClusterInput, chunk: int = CHUNK) -> Outputs[Tensor]:
    """Return the network's outputs for one or more clusters.

    Most clusters have few points, so clusters of similar size form batches that are padded only to
    their largest cluster.
    """
    device, min_size = network.temperature.device, network.config.min_points
    sizes = np.maximum(inputs.valid.sum(axis=1), min_size)
    doublings = np.ceil(np.log2(sizes / min_size))
    order = np.argsort(doublings, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(doublings[order])) + 1)
    batch_outputs = []
    for rows in groups:
        width = sizes[rows].max()
        for begin in range(0, len(rows), chunk):
            batch = rows[begin : begin + chunk]
            batch_outputs.append(
                network(
                    *(
                        torch.from_numpy(x).to(device)
                        for x in (inputs.points[batch, :width], inputs.valid[batch, :width], inputs.context[batch])
                    )
                )
            )
    inverse_order = torch.from_numpy(np.argsort(order)).to(device)
    return Outputs(*(torch.cat(column)[inverse_order] for column in zip(*batch_outputs)))

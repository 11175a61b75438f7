"""The cluster network in torch, in inference mode."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lidar_perception.detectors.devices import CPU
from lidar_perception.detectors.layer_weights import arrays_of
from lidar_perception.detectors.matrix_kernel import LANES
from lidar_perception.detectors.pointnet.box_head import Outputs
from lidar_perception.detectors.pointnet.clusters import ClusterInput
from lidar_perception.detectors.pointnet.compiled import CompiledPointNet
from lidar_perception.detectors.pointnet.network import PointNet
from lidar_perception.runs.threads import set_torch_threads

CHUNK = 256  # clusters at a time: bounds the memory, and the caches like it


class TorchPointNet:
    """A PointNet in eval mode, on its device.

    Args:
        engine: what runs it on the CPU: torch; or auto, compiled kernels if the CPU has AVX2.
    """

    def __init__(self, network: PointNet, engine: str = "torch"):
        set_torch_threads()
        self.network, self.config = network, network.config
        self.temperature, self.offsets = (values.detach().cpu().numpy()
                                          for values in (network.temperature, network.offsets))
        self.compiled = CompiledPointNet(network.config, arrays_of(network)) if (
            LANES and engine == "auto") else None

    def to(self, device: str) -> None:
        self.network.to(device)

    def __call__(self, inputs: ClusterInput) -> Outputs[np.ndarray]:
        if self.compiled and self.network.temperature.device.type == CPU:
            return self.compiled(inputs)
        return Outputs(*(values.float().cpu().numpy()
                         for values in outputs_of(self.network, inputs)))


@torch.inference_mode()
def outputs_of(network: PointNet, inputs: ClusterInput, chunk: int = CHUNK) -> Outputs[Tensor]:
    """The network's outputs for one cluster or more. Most clusters have few points: those that have
    about the same number are taken together, without the places that none of them fills."""
    device, least = network.temperature.device, network.config.least_points
    sizes = np.maximum(inputs.valid.sum(axis=1), least)
    doubled = np.ceil(np.log2(sizes / least))
    order = np.argsort(doubled, kind="stable")
    alike = np.split(order, np.flatnonzero(np.diff(doubled[order])) + 1)
    parts = []
    for rows in alike:
        width = sizes[rows].max()
        for begin in range(0, len(rows), chunk):
            part = rows[begin:begin + chunk]
            parts.append(network(*(torch.from_numpy(x).to(device) for x in (
                inputs.points[part, :width], inputs.valid[part, :width], inputs.context[part]))))
    back = torch.from_numpy(np.argsort(order)).to(device)
    return Outputs(*(torch.cat(column)[back] for column in zip(*parts)))

"""PointPillars in inference mode: layers in torch or in the sparse engine."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from lidar_perception.detectors.devices import CPU, choose_dtype
from lidar_perception.detectors.pointpillars.network import PointPillars, Prediction, fused
from lidar_perception.detectors.pointpillars.pillars import Pillars
from lidar_perception.detectors.pointpillars.sparse import SparseNetwork, unsupported
from lidar_perception.types import InputError


class Network(Protocol):
    """A network that a PointPillarsProposer can run: a TorchNetwork or an OnnxNetwork."""

    def to(self, device: torch.device) -> None:
        """Move to another device if the network can."""

    def __call__(self, pillars: Pillars, maps: Tensor | None) -> Prediction:
        """Return the outputs for one cloud; maps as in PointPillars.features."""


class TorchNetwork:
    """A PointPillars network with batch norms folded into its layers.

    Args:
        amp: number format of the layers, see devices.choose_dtype.
        engine: what runs the layers on the CPU: torch; sparse, see sparse.py; or auto, sparse if
            it can.

    Raises:
        InputError: the engine is sparse and cannot run this network.
    """

    def __init__(self, network: PointPillars, device: torch.device = CPU, amp: str = "off",
                 engine: str = "torch"):
        network = fused(network)
        self.sparse = _make_sparse(network, amp, engine)
        self.network, self.amp = network.to(device), amp

    def to(self, device: torch.device) -> None:
        self.network.to(device)

    def __call__(self, pillars: Pillars, maps: Tensor | None) -> Prediction:
        device = pillars.points.device
        if self.sparse and device == CPU:
            return self.sparse(pillars, maps)
        numbers = choose_dtype(self.amp, device)
        with torch.autocast(device.type, numbers, enabled=numbers is not None):
            features = self.network.features(pillars, maps).float()
        head = self.network.head
        return Prediction(head.logits(features)[0],
                          lambda anchors: head.boxes_at(features, anchors))


def _make_sparse(network: PointPillars, amp: str, engine: str) -> SparseNetwork | None:
    if engine == "torch":
        return None
    reason = unsupported(network)
    if not reason and choose_dtype(amp, CPU):
        reason = "it works in float32, and amp asks for 16 bits"
    if not reason:
        return SparseNetwork(network)
    if engine == "sparse":
        raise InputError(f"the sparse engine cannot run this network: {reason}; choose the engine "
                         "auto or torch")
    return None

"""PointPillars in torch, in inference mode."""

from __future__ import annotations

import numpy as np
import torch

from lidar_perception.detectors.devices import CPU, choose_dtype, uses_16_bits
from lidar_perception.detectors.layer_weights import to_arrays
from lidar_perception.detectors.pointpillars.network import PointPillars, fuse_norms
from lidar_perception.detectors.pointpillars.pillars import Pillars
from lidar_perception.detectors.pointpillars.prediction import Prediction
from lidar_perception.detectors.pointpillars.sparse import SparseNetwork, find_unsupported_part
from lidar_perception.runs.threads import set_torch_threads
from lidar_perception.types import InputError


class TorchNetwork:
    """A PointPillars network with batch norms folded into its layers.

    Args:
        amp: number format of the layers, see devices.choose_dtype.
        engine: implementation on the CPU: torch; sparse, see sparse.py; or auto, sparse if
            possible.

    Raises:
        InputError: the engine is sparse and cannot run this network.
    """

    has_fixed_range = False

    def __init__(self, network: PointPillars, device: str = CPU, amp: str = "off",
                 engine: str = "torch"):
        set_torch_threads()
        self.sparse = _make_sparse(network, amp, engine)
        self.network, self.amp, self.device = fuse_norms(network).to(device), amp, device

    def to(self, device: str) -> None:
        self.network.to(device)
        self.device = device

    @torch.inference_mode()
    def __call__(self, pillars: Pillars[np.ndarray], maps: np.ndarray | None) -> Prediction:
        if self.sparse and self.device == CPU:
            return self.sparse(pillars, maps)
        points, offsets, cells = (torch.from_numpy(x).to(self.device) for x in pillars[:3])
        own_maps = None if maps is None else torch.from_numpy(maps).to(self.device)
        numbers = choose_dtype(self.amp, self.device)
        with torch.autocast(torch.device(self.device).type, numbers, enabled=numbers is not None):
            features = self.network.features(
                Pillars(points, offsets, cells, *pillars[3:]), own_maps).float()
        head = self.network.head

        @torch.inference_mode()
        def boxes_at(chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            codes, directions = head.boxes_at(features, torch.from_numpy(chosen).to(self.device))
            return codes.float().cpu().numpy(), directions.float().cpu().numpy()

        return Prediction(head.logits(features)[0].float().cpu().numpy(), boxes_at)


def _make_sparse(network: PointPillars, amp: str, engine: str) -> SparseNetwork | None:
    if engine == "torch":
        return None
    config = network.pillar_net.config
    reason = find_unsupported_part(config)
    if not reason and uses_16_bits(amp):
        reason = "it supports float32 only, and amp selects 16 bits"
    if not reason:
        return SparseNetwork(config, to_arrays(network))
    if engine == "sparse":
        raise InputError(f"the sparse engine cannot run this network: {reason}; choose the engine "
                         "auto or torch")
    return None

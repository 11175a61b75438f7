"""PointPillars in torch, in inference mode."""

from __future__ import annotations

import numpy as np
import torch

from lidar_perception.detectors.devices import CPU, choose_dtype
from lidar_perception.detectors.pointpillars.network import PointPillars, fuse_norms
from lidar_perception.detectors.pointpillars.pillars import Pillars
from lidar_perception.detectors.pointpillars.prediction import Prediction
from lidar_perception.runs.threads import set_torch_threads


class TorchNetwork:
    """PointPillars network in torch, with batch norms folded into its layers.

    Args:
        amp: number format of the layers, see devices.choose_dtype.
    """

    has_fixed_range = False

    def __init__(self, network: PointPillars, device: str = CPU, amp: str = "off"):
        set_torch_threads()
        self.network, self.amp, self.device = fuse_norms(network).to(device), amp, device

    def to(self, device: str) -> None:
        self.network.to(device)
        self.device = device

    @torch.inference_mode()
    def __call__(self, pillars: Pillars[np.ndarray], maps: np.ndarray | None) -> Prediction:
        points, offsets, cells = (torch.from_numpy(x).to(self.device) for x in pillars[:3])
        device_maps = None if maps is None else torch.from_numpy(maps).to(self.device)
        dtype = choose_dtype(self.amp, self.device)
        with torch.autocast(torch.device(self.device).type, dtype, enabled=dtype is not None):
            features = self.network.compute_features(Pillars(points, offsets, cells, *pillars[3:]), device_maps).float()
        head = self.network.head

        @torch.inference_mode()
        def compute_boxes(indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            codes, directions = head.compute_boxes(features, torch.from_numpy(indices).to(self.device))
            return codes.float().cpu().numpy(), directions.float().cpu().numpy()

        return Prediction(head.compute_logits(features)[0].float().cpu().numpy(), compute_boxes)

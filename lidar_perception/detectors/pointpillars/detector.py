"""A cloud in, boxes out: the network with its experts before it and NMS after it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from lidar_perception.detectors.base import NetworkDetector
from lidar_perception.detectors.calibration import calibrated
from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.contract import Found
from lidar_perception.detectors.devices import CPU, chosen_device
from lidar_perception.detectors.nms import best_of_each, suppressed
from lidar_perception.detectors.pointpillars.anchors import make_anchors
from lidar_perception.detectors.pointpillars.box_coder import decode
from lidar_perception.detectors.pointpillars.config import RANGES
from lidar_perception.detectors.pointpillars.expert import NetworkInput, network_input
from lidar_perception.detectors.pointpillars.network import (
    PointPillars,
    Prediction,
    fused,
    load_network,
)
from lidar_perception.detectors.pointpillars.params import STEPS, DetectorParams
from lidar_perception.detectors.pointpillars.pillars import Pillars, make_pillars
from lidar_perception.detectors.pointpillars.weights_file import weights_file
from lidar_perception.detectors.view import (
    in_sensor_frame,
    made_up_frame,
    visible,
    with_intensity_scaled,
)
from lidar_perception.types import SENSOR_HEIGHT, Detections, InputError, LidarFrame


class Network(Protocol):
    """What runs in the detector: torch's network, or an exported one."""

    def to(self, device: torch.device) -> None:
        """Move to another device, where it can."""

    def __call__(self, pillars: Pillars, maps: Tensor | None) -> Prediction:
        """See Prediction; maps as in PointPillars.features."""


class TorchNetwork:
    """A network on a device, its norms folded into its layers."""

    def __init__(self, network: PointPillars, device: torch.device = CPU):
        self.network = fused(network).to(device)

    def to(self, device: torch.device) -> None:
        """Move to another device."""
        self.network.to(device)

    def __call__(self, pillars: Pillars, maps: Tensor | None) -> Prediction:
        features = self.network.features(pillars, maps)
        head = self.network.head
        return head.logits(features)[0], lambda anchors: head.boxes_at(features, anchors)


class PointPillarsDetector(NetworkDetector):
    """EG-PointPillars of any version as a detector, see contract.py."""

    def __init__(self, network: Network, header: Header, device: torch.device,
                 params: DetectorParams = DetectorParams()):
        super().__init__(header, device, params)
        self.network = network
        self.anchors = make_anchors(self.config, device)

    def detect(self, frame: LidarFrame, ground: np.ndarray | None,
               cluster_ids: np.ndarray | None) -> Found:
        """Columns are computed only if the version needs them."""
        t0 = perf_counter()
        pose = self.params.ground.sensor_pose
        indices, seen = visible(frame, self.config, pose)
        seen = with_intensity_scaled(seen, self.settings.intensity_scale)
        t1 = perf_counter()
        inputs = network_input(
            seen, self.config, None if ground is None else ground.take(indices).astype(bool),
            None if cluster_ids is None else cluster_ids.take(indices),
            self.params.ground, self.params.clustering)
        t2 = perf_counter()
        problem = self._problem(frame, seen, inputs)
        if len(inputs.points) == 0:
            return Found(Detections.none(),
                         dict(zip(STEPS, ((t1 - t0) * 1e3, (t2 - t1) * 1e3, 0.0, 0.0))),
                         problem or self.fallback)
        with torch.inference_mode():
            t3, t4, detections, best, broken = self.guarded(lambda: self._predict(inputs))
            detections = in_sensor_frame(detections, pose)
        t5 = perf_counter()
        ms = dict(zip(STEPS, (
            (t1 - t0 + t3 - t2) * 1e3, (t2 - t1) * 1e3, (t4 - t3) * 1e3, (t5 - t4) * 1e3)))
        return Found(detections, ms, broken or problem or self.fallback, best)

    def _predict(self, inputs: NetworkInput) -> tuple:
        """When the network began and ended, detections, and what nothing_passed gives."""
        points = torch.from_numpy(inputs.points).to(self.device)
        maps = None
        if inputs.cluster_map is not None:
            maps = torch.from_numpy(inputs.cluster_map)[None].to(self.device)
        pillars = make_pillars([points], self.config)
        begun = self.now()
        logits, boxes_at = self.network(pillars, maps)
        ended = self.now()
        return begun, ended, *self._detections(logits, boxes_at)

    def _detections(self, logits: Tensor, boxes_at: Callable) -> tuple:
        settings, broken = self.settings, None
        best_scores: dict[str, float] = {}
        limits = logits.new_tensor([*map(_logit, self.raw_min_scores())])
        chosen = torch.nonzero((logits >= limits).any(dim=1))[:, 0]
        if len(logits) > 1 and (logits == logits[0]).all():
            chosen, broken = chosen[:0], ("the network gives every place the same scores; the "
                                          "weights are broken, take others")
        elif len(chosen) == 0:
            best_scores, broken = self.nothing_passed(torch.sigmoid(logits.amax(dim=0)).tolist())
        best, labels = logits[chosen].max(dim=1)
        valid = torch.nonzero(best >= limits[labels])[:, 0]
        if len(valid) > settings.nms.candidates:
            valid = valid[best[valid].topk(settings.nms.candidates).indices]
        chosen, best, labels = chosen[valid], best[valid], labels[valid]
        codes, directions = boxes_at(chosen)
        boxes = decode(codes.float(), directions.argmax(dim=1), self.anchors[chosen],
                       self.config.direction_offset).cpu().numpy()
        detections = best_of_each(boxes, torch.sigmoid(best).cpu().numpy(), labels.cpu().numpy(),
                                  self.config.classes, settings.nms)
        return calibrated(detections, self.header.calibration), best_scores, broken

    def out_of_sight(self, frame: LidarFrame, seen: LidarFrame) -> str | None:
        """Why nothing of the frame is seen, with the remedy; None where something is."""
        if len(frame) == 0:
            return "the cloud is empty or has no finite point, or crop.* leaves none"
        if len(seen) == 0:
            low, high = self.config.low, self.config.high
            return (f"no point lies in the network's range, x {low[0]:g} .. {high[0]:g}, y "
                    f"{low[1]:g} .. {high[1]:g}, z {low[2]:g} .. {high[2]:g} m under a sensor "
                    f"{SENSOR_HEIGHT} m high; is x forward, and ground.sensor_pose right?")
        return None

    def _problem(self, frame: LidarFrame, seen: LidarFrame, inputs: NetworkInput) -> str | None:
        if blind := self.out_of_sight(frame, seen):
            return blind
        if len(inputs.points) == 0:
            return ("every point in the network's range is ground; is the sensor mounted at "
                    "another height or angle? set ground.sensor_pose")
        if frame.intensity is None and self.settings.intensity_scale:
            return "the cloud has no intensity, which the network was trained with; it reads zeros"
        return None

    def seeing(self, where: str) -> PointPillarsDetector:
        """The same network with one of the RANGES: what it knows of a place it knows of all."""
        header = replace(self.header, config=replace(self.config, **RANGES[where]))
        return PointPillarsDetector(self.network, header, self.device, self.params)

    def bring_to(self, device: torch.device) -> None:
        """Bring network and anchors to a device."""
        self.network.to(device)
        self.anchors = make_anchors(self.config, device)

    def warm_up(self) -> None:
        """Run every part once on made-up points, so that what is compiled is compiled."""
        self(made_up_frame(self.params.ground.sensor_pose))
        suppressed(np.ones((2, 7)), np.ones(2), np.zeros(2, int), 0.5)


def _logit(score: float) -> float:
    if score in (0.0, 1.0):
        return math.copysign(math.inf, score - 0.5)
    return math.log(score / (1 - score))


def load_detector(path: str | Path = "", device: str = "auto",
                  params: DetectorParams = DetectorParams()) -> PointPillarsDetector:
    """A detector from a checkpoint (.safetensors) or an exported network (.onnx); with an empty
    path the one that params name, or else the one that comes with the package. InputError where it
    is missing, or not of the version and size that params ask for, or device is not there."""
    path = Path(path) if str(path) not in ("", ".") else weights_file(params.pointpillars)
    if params.pointpillars.threads:
        torch.set_num_threads(params.pointpillars.threads)
    network: Network
    if path.suffix == ".onnx":
        from lidar_perception.detectors.pointpillars.onnx import OnnxNetwork
        header, network = OnnxNetwork.load(path)
        where = CPU
        if device not in ("auto", "cpu"):
            raise InputError(f"{path} runs in ONNX Runtime on the CPU, not on {device!r}; use the "
                             "checkpoint it was exported from")
    else:
        where = chosen_device(device)
        header, loaded = load_network(path)
        network = TorchNetwork(loaded, CPU)
    for name in "version", "size":
        wanted, found = getattr(params.pointpillars, name), getattr(header.config, name)
        if wanted not in ("auto", found):
            raise InputError(f"{path} holds {name} {found}, asked for was {wanted}; change "
                             f"pointpillars.{name} or pointpillars.weights")
    detector = PointPillarsDetector(network, header, CPU, params)
    detector.move(where)
    if params.pointpillars.warm_up:
        detector.warm_up()
    return detector

"""A cloud in, boxes out: the network with its experts before it and NMS after it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import reduce
from pathlib import Path
from time import perf_counter
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from lidar_perception.detectors.base import NetworkDetector
from lidar_perception.detectors.calibration import calibrated
from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.contract import Found
from lidar_perception.detectors.devices import CPU, chosen_device, number_format
from lidar_perception.detectors.nms import best_of_each, suppressed
from lidar_perception.detectors.pointpillars.anchors import make_anchors
from lidar_perception.detectors.pointpillars.box_coder import decode
from lidar_perception.detectors.pointpillars.config import HALF, RANGES, NetworkConfig
from lidar_perception.detectors.pointpillars.expert import NetworkInput, experts, network_input
from lidar_perception.detectors.pointpillars.network import (
    PointPillars,
    Prediction,
    fused,
    load_network,
)
from lidar_perception.detectors.pointpillars.params import STEPS, DetectorParams
from lidar_perception.detectors.pointpillars.pillars import Pillars, make_pillars
from lidar_perception.detectors.pointpillars.sparse import SparseNetwork, unsupported
from lidar_perception.detectors.pointpillars.weights_file import weights_file
from lidar_perception.detectors.view import (
    as_found,
    made_up_frame,
    turned_about,
    turned_boxes,
    visible,
    with_intensity_scaled,
)
from lidar_perception.types import SENSOR_HEIGHT, Detections, InputError, LidarFrame

SHARED = 1.0  # m behind the sensor; what has its centre there is taken from either look


class Network(Protocol):
    """What runs in the detector: torch's network, or an exported one."""

    def to(self, device: torch.device) -> None:
        """Move to another device, where it can."""

    def __call__(self, pillars: Pillars, maps: Tensor | None) -> Prediction:
        """See Prediction; maps as in PointPillars.features."""


class TorchNetwork:
    """A network on a device, its norms folded into its layers, which work in the format of
    number_format(amp).

    engine: what runs it on the CPU: torch; sparse, see sparse.py; or auto, sparse where it can.
    InputError for sparse where it cannot.
    """

    def __init__(self, network: PointPillars, device: torch.device = CPU, amp: str = "off",
                 engine: str = "torch"):
        network = fused(network)
        self.sparse = _sparse(network, amp, engine)
        self.network, self.amp = network.to(device), amp

    def to(self, device: torch.device) -> None:
        """Move to another device."""
        self.network.to(device)

    def __call__(self, pillars: Pillars, maps: Tensor | None) -> Prediction:
        device = pillars.points.device
        if self.sparse and device == CPU:
            return self.sparse(pillars, maps)
        numbers = number_format(self.amp, device)
        with torch.autocast(device.type, numbers, enabled=numbers is not None):
            features = self.network.features(pillars, maps).float()
        head = self.network.head
        return Prediction(head.logits(features)[0],
                          lambda anchors: head.boxes_at(features, anchors))


def _sparse(network: PointPillars, amp: str, engine: str) -> SparseNetwork | None:
    """The network in the sparse engine; None where torch runs it."""
    if engine == "torch":
        return None
    reason = unsupported(network)
    if not reason and number_format(amp, CPU):
        reason = "it works in float32, and amp asks for 16 bits"
    if not reason:
        return SparseNetwork(network)
    if engine == "sparse":
        raise InputError(f"the sparse engine cannot run this network: {reason}; choose the engine "
                         "auto or torch")
    return None


class Boxes(NamedTuple):
    """What passed in one look, before NMS: boxes (M, 7), their best logits (M,) and labels (M,)
    int, indices in the classes."""

    boxes: np.ndarray
    logits: np.ndarray
    labels: np.ndarray


class PointPillarsDetector(NetworkDetector):
    """EG-PointPillars of any version as a detector, see contract.py.

    It looks once, at the range of its config. With a look at a HALF of it, for a network that knows
    only what is ahead, it looks twice, the second time at the cloud turned about the sensor by 180
    degrees: what is behind is then ahead. Experts see the whole range, once.
    """

    def __init__(self, network: Network, header: Header, device: torch.device,
                 params: DetectorParams = DetectorParams(), look: NetworkConfig | None = None):
        super().__init__(header, device, params)
        self.network = network
        self.look = look or self.config
        self.turns = (False,) if look is None else (False, True)
        self.anchors = make_anchors(self.look, device)

    def detect(self, frame: LidarFrame, ground: np.ndarray | None,
               cluster_ids: np.ndarray | None) -> Found:
        """Columns are computed only if the version needs them."""
        found = self.propose(frame, ground, cluster_ids)
        return replace(found, detections=as_found(found.detections,
                                                  self.params.ground.sensor_pose))

    def propose(self, frame: LidarFrame, ground: np.ndarray | None = None,
                cluster_ids: np.ndarray | None = None) -> Found:
        """What is detected, as from a level sensor at SENSOR_HEIGHT, with what carries the sensor
        among it."""
        t0 = perf_counter()
        indices, seen = visible(frame, self.config, self.params.ground.sensor_pose)
        seen = with_intensity_scaled(seen, self.settings.intensity_scale)
        t1 = perf_counter()
        looks = self._looks(seen, *experts(
            seen, self.config, None if ground is None else ground.take(indices).astype(bool),
            _taken(cluster_ids, indices), self.params.ground, self.params.clustering))
        t2 = perf_counter()
        problem = self._problem(frame, seen, looks)
        if not looks:
            return Found(Detections.none(),
                         dict(zip(STEPS, ((t1 - t0) * 1e3, (t2 - t1) * 1e3, 0.0, 0.0))),
                         problem or self.fallback)
        with torch.inference_mode():
            t3, t4, detections, best, broken = self.guarded(lambda: self._predict(looks))
        t5 = perf_counter()
        ms = dict(zip(STEPS, (
            (t1 - t0 + t3 - t2) * 1e3, (t2 - t1) * 1e3, (t4 - t3) * 1e3, (t5 - t4) * 1e3)))
        return Found(detections, ms, broken or problem or self.fallback, best)

    def _looks(self, seen: LidarFrame, ground: np.ndarray | None,
               cluster_ids: np.ndarray | None) -> dict[bool, NetworkInput]:
        """The network's inputs, by whether they are turned, where there are any."""
        inputs = {}
        if len(self.turns) > 1 and self.config.remove_ground and ground is not None:
            kept = np.flatnonzero(~ground)  # the passes read no other points
            seen, ground, cluster_ids = seen.take(kept), ground[kept], _taken(cluster_ids, kept)
        for turned in self.turns:
            part, own_ground, own_ids = seen, ground, cluster_ids
            if len(self.turns) > 1:
                indices, part = visible(turned_about(seen) if turned else seen, self.look)
                own_ground, own_ids = _taken(ground, indices), _taken(cluster_ids, indices)
            inputs[turned] = network_input(part, self.look, own_ground, own_ids)
        return {turned: given for turned, given in inputs.items() if len(given.points)}

    def _predict(self, looks: dict[bool, NetworkInput]) -> tuple:
        """When the network began and ended, detections, and what nothing_passed gives."""
        given = []
        for inputs in looks.values():
            points = torch.from_numpy(inputs.points).to(self.device)
            maps = None
            if inputs.cluster_map is not None:
                maps = torch.from_numpy(inputs.cluster_map)[None].to(self.device)
            given.append((make_pillars([points], self.look), maps))
        begun = self.now()
        predictions = [self.network(*inputs) for inputs in given]
        ended = self.now()
        return begun, ended, *self._detections(dict(zip(looks, predictions)))

    def _detections(self, predictions: dict[bool, Prediction]) -> tuple:
        """Detections, and what nothing_passed gives, of all looks together."""
        found = [self._passed(turned, said) for turned, said in predictions.items()]
        boxes, best_logits, labels = map(np.concatenate, zip(*found))
        best: dict[str, float] = {}
        broken: str | None = None
        scored = [said.logits for said in predictions.values() if len(said.logits)]
        if any(len(logits) > 1 and torch.equal(logits[0], logits[-1])
               and (logits == logits[0]).all() for logits in scored):
            boxes, best_logits, labels = boxes[:0], best_logits[:0], labels[:0]
            broken = ("the network gives every place the same scores; the weights are broken, "
                      "take others")
        elif len(boxes) == 0 and scored:
            highest = torch.cat(scored).amax(dim=0)
            best, broken = self.nothing_passed(torch.sigmoid(highest).tolist())
        scores = torch.sigmoid(torch.from_numpy(best_logits)).numpy()
        detections = best_of_each(boxes, scores, labels, self.config.classes, self.settings.nms)
        return calibrated(detections, self.header.calibration), best, broken

    def _passed(self, turned: bool, prediction: Prediction) -> Boxes:
        """The boxes of one look whose score suffices, turned back."""
        logits = prediction.logits
        limits = logits.new_tensor([*map(_logit, self.raw_min_scores())])
        # One class after the other: a reduction over three columns takes three times as long.
        passes = reduce(torch.logical_or, map(torch.ge, logits.unbind(dim=1), limits))
        chosen = torch.nonzero(passes)[:, 0]
        best, labels = logits[chosen].max(dim=1)
        valid = torch.nonzero(best >= limits[labels])[:, 0]
        if len(valid) > self.settings.nms.candidates:
            valid = valid[best[valid].topk(self.settings.nms.candidates).indices]
        chosen, best, labels = chosen[valid], best[valid], labels[valid]
        codes, directions = prediction.boxes_at(chosen)
        if self.anchors.device != codes.device:  # the network was moved, maybe by another detector
            self.anchors = make_anchors(self.look, codes.device)
        if prediction.anchors is not None:
            chosen = prediction.anchors[chosen]
        boxes = decode(codes.float(), directions.argmax(dim=1), self.anchors[chosen],
                       self.config.direction_offset).cpu().numpy()
        found = Boxes(boxes, best.cpu().numpy(), labels.cpu().numpy())
        if len(self.turns) > 1:
            own = boxes[:, 0] >= -SHARED
            found = Boxes(*(column[own] for column in found))
        return found._replace(boxes=turned_boxes(found.boxes)) if turned else found

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

    def _problem(self, frame: LidarFrame, seen: LidarFrame,
                 looks: dict[bool, NetworkInput]) -> str | None:
        if blind := self.out_of_sight(frame, seen):
            return blind
        if seen.intensity is not None and (
                lost := len(seen) - np.count_nonzero(np.isfinite(seen.intensity))):
            return (f"{lost} of {len(seen)} points are not seen, as their intensity is no number "
                    "(NaN); give 0 where it is not known")
        if not looks:
            return ("every point in the network's range is ground; is the sensor mounted at "
                    "another height or angle? set ground.sensor_pose")
        return self.no_intensity(frame)

    def with_range(self, range: str) -> PointPillarsDetector:
        """See base. A network that was trained ahead sees around in two passes. InputError where
        its cells do not fit the range, and for an exported network, which has one range."""
        if range == "auto" or (range == "around") == (self.config.low[0] < 0):
            return self
        if not isinstance(self.network, TorchNetwork):
            raise InputError("an exported network sees what it was exported for; take the "
                             f"checkpoint to see {range}")
        try:
            config = replace(self.config, **RANGES[range])
            look = replace(self.config, **HALF) if range == "around" else None
        except ValueError as error:
            raise InputError(f"this network cannot see {range}: {error}") from None
        other = PointPillarsDetector(self.network, replace(self.header, config=config),
                                     self.device, self.params, look)
        other.place = self.place
        return other

    def bring_to(self, device: torch.device) -> None:
        """Bring the network and its anchors to a device."""
        self.network.to(device)
        if self.anchors.device != device:
            self.anchors = make_anchors(self.look, device)

    def warm_up(self) -> None:
        """Run every part once on made-up points, so that what is compiled is compiled."""
        self(made_up_frame(self.params.ground.sensor_pose))
        suppressed(np.ones((2, 7)), np.ones(2), np.zeros(2, int), 0.5)


def _taken(column: np.ndarray | None, indices: np.ndarray) -> np.ndarray | None:
    return None if column is None else column.take(indices)


def _logit(score: float) -> float:
    if score in (0.0, 1.0):
        return math.copysign(math.inf, score - 0.5)
    return math.log(score / (1 - score))


def load_detector(path: str | Path = "", device: str = "auto",
                  params: DetectorParams = DetectorParams()) -> PointPillarsDetector:
    """A detector from a checkpoint (.safetensors) or an exported network (.onnx); with an empty
    path the one that params name, or else the one that comes with the package. InputError where it
    is missing, or not of the version and size that params ask for, or device is not there, or the
    engine cannot run it."""
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
        if params.pointpillars.amp == "bf16":
            raise InputError(f"{path} works in the numbers it was exported with; set amp: off, or "
                             "use the checkpoint it was exported from")
        if params.pointpillars.engine != "auto":
            raise InputError(f"{path} runs in ONNX Runtime; set engine: auto, or use the "
                             "checkpoint it was exported from")
    else:
        where = chosen_device(device)
        header, loaded = load_network(path)
        if where != CPU and params.pointpillars.engine == "sparse":
            raise InputError(f"the sparse engine runs on the CPU, not on {where}; set device: cpu, "
                             "or engine: auto")
        network = TorchNetwork(loaded, CPU, params.pointpillars.amp, params.pointpillars.engine)
    for name in "version", "size":
        wanted, found = getattr(params.pointpillars, name), getattr(header.config, name)
        if wanted not in ("auto", found):
            raise InputError(f"{path} holds {name} {found}, asked for was {wanted}; change "
                             f"pointpillars.{name} or pointpillars.weights")
    detector = PointPillarsDetector(network, header, CPU, params)
    detector = detector.with_range(params.pointpillars.range)
    detector.move(where)
    if params.pointpillars.warm_up:
        detector.warm_up()
    return detector

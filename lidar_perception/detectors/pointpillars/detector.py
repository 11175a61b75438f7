"""EG-PointPillars detector: ground and cluster experts, followed by the network (paper B)."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np

from lidar_perception.detectors.base import NetworkDetector, make_synthetic_frame
from lidar_perception.detectors.checkpoint import Header, read_arrays, read_header
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.detectors.devices import CPU, find_device, uses_bf16_on_cpu
from lidar_perception.detectors.layer_weights import WeightsMismatch, to_arrays
from lidar_perception.detectors.nms import rotated_nms
from lidar_perception.detectors.normalized_view import NormalizedView, restore_detections
from lidar_perception.detectors.pointpillars.config import NetworkConfig
from lidar_perception.detectors.pointpillars.expert import run_experts
from lidar_perception.detectors.pointpillars.params import STEPS, DetectorParams, PointPillarsParams
from lidar_perception.detectors.pointpillars.prediction import Network
from lidar_perception.detectors.pointpillars.proposer import PointPillarsProposer
from lidar_perception.detectors.pointpillars.sparse import SparseNetwork, find_unsupported_feature
from lidar_perception.detectors.weights_file import find_pointpillars_weights
from lidar_perception.runs.threads import set_thread_count
from lidar_perception.types import InputError, PointCloud


class PointPillarsDetector(NetworkDetector):
    """EG-PointPillars of any version as a detector, see contract.Detector.

    If a call passes no ground or no clusters, they are computed if the version needs them.
    """

    group = "pointpillars"
    params: DetectorParams

    def __init__(self, proposer: PointPillarsProposer, params: DetectorParams = DetectorParams()):
        super().__init__(params)
        self.proposer = proposer

    @property
    def networks(self) -> tuple[PointPillarsProposer]:
        return (self.proposer,)

    @property
    def settings(self) -> PointPillarsParams:
        return self.params.pointpillars

    def detect(self, frame: PointCloud, ground: np.ndarray | None, cluster_ids: np.ndarray | None) -> DetectionResult:
        result = self.propose(frame, ground, cluster_ids)
        return replace(result, detections=restore_detections(result.detections, self.params.ground.sensor_pose))

    def propose(
        self, frame: PointCloud, ground: np.ndarray | None = None, cluster_ids: np.ndarray | None = None
    ) -> DetectionResult:
        """Detect objects in the coordinates of a NormalizedView, without dropping the ego vehicle."""
        t0 = perf_counter()
        config, settings = self.proposer.config, self.settings
        view = NormalizedView.of(frame, self.params.ground.sensor_pose, config.low, config.high, settings.use_intensity)
        t1 = perf_counter()
        columns = run_experts(
            view.frame, config, view.take(ground), view.take(cluster_ids), self.params.ground, self.params.clustering
        )
        t2 = perf_counter()
        result = self.proposer.propose(view, *columns, settings.scores, settings.nms, settings.cpu_fallback)
        timings = {**dict.fromkeys(STEPS, 0.0), **result.timings}
        timings["preprocess"] += (t1 - t0) * 1e3
        timings["experts"] = (t2 - t1) * 1e3
        return replace(result, timings=timings)

    def with_range(self, range: str) -> PointPillarsDetector:
        return self._with_proposer(self.proposer.with_range(range))

    def with_raw_scores(self) -> PointPillarsDetector:
        return self._with_proposer(self.proposer.with_raw_scores())

    def _with_proposer(self, proposer: PointPillarsProposer) -> PointPillarsDetector:
        if proposer is self.proposer:
            return self
        other = copy.copy(self)
        other.proposer = proposer
        return other

    def warm_up(self) -> None:
        """Run every step once on synthetic points to trigger JIT compilation."""
        self(make_synthetic_frame(self.params.ground.sensor_pose))
        rotated_nms(np.ones((2, 7)), np.ones(2), np.zeros(2, int), 0.5)


def load_detector(
    path: str | Path = "", device: str = "auto", params: DetectorParams = DetectorParams()
) -> PointPillarsDetector:
    """Load a detector from a checkpoint (.safetensors) or an exported network (.onnx).

    Args:
        path: weights file; empty: `params.pointpillars.weights`, by default the shipped file.

    Raises:
        InputError: the file is missing, its version or size differs from `params`, the device does
            not exist, or the engine cannot run the network.
    """
    path = Path(path) if str(path) not in ("", ".") else find_pointpillars_weights(params.pointpillars)
    if params.pointpillars.threads:
        set_thread_count(params.pointpillars.threads)
    network: Network
    if path.suffix == ".onnx":
        from lidar_perception.detectors.pointpillars.onnx import OnnxNetwork

        header, network = OnnxNetwork.load(path)
        target = CPU
        if device not in ("auto", "cpu"):
            raise InputError(
                f"{path} runs in ONNX Runtime on the CPU, not on {device!r}; use the checkpoint it was exported from"
            )
        if params.pointpillars.amp == "bf16":
            raise InputError(
                f"{path} uses the number format it was exported with; set amp: off, or "
                "use the checkpoint it was exported from"
            )
        if params.pointpillars.engine != "auto":
            raise InputError(
                f"{path} runs in ONNX Runtime; set engine: auto, or use the checkpoint it was exported from"
            )
    else:
        target = find_device(device)
        if target != CPU and params.pointpillars.engine == "sparse":
            raise InputError(f"the sparse engine runs on the CPU, not on {target}; set device: cpu, or engine: auto")
        header, network = _load_network(path, target, params.pointpillars)
    for name in "version", "size":
        expected, actual = getattr(params.pointpillars, name), getattr(header.config, name)
        if expected not in ("auto", actual):
            raise InputError(
                f"{path} has {name} {actual}, not {expected}; change pointpillars.{name} or pointpillars.weights"
            )
    proposer = PointPillarsProposer(network, header).with_range(params.pointpillars.range)
    proposer.move(target, params.pointpillars.cpu_fallback)
    detector = PointPillarsDetector(proposer, params)
    if params.pointpillars.warm_up:
        detector.warm_up()
    return detector


def _load_network(path: Path, device: str, params: PointPillarsParams) -> tuple[Header, Network]:
    """Load the network of a checkpoint. torch is used only if the sparse engine cannot run it."""
    if device == CPU and params.engine != "torch":
        reason = find_unsupported_feature(read_header(path, NetworkConfig).config)
        if not reason and uses_bf16_on_cpu(params.amp):
            reason = "it supports float32 only, and amp selects 16 bits"
        if not reason:
            return _load_sparse(path)
        if params.engine == "sparse":
            raise InputError(f"the sparse engine cannot run this network: {reason}; set engine: auto or torch")
    from lidar_perception.detectors.pointpillars.network import load_network
    from lidar_perception.detectors.pointpillars.torch_network import TorchNetwork

    header, network = load_network(path)
    return header, TorchNetwork(network, CPU, params.amp)


def _load_sparse(path: Path) -> tuple[Header, SparseNetwork]:
    try:
        header, tensors = read_arrays(path, NetworkConfig)
        return header, SparseNetwork(header.config, tensors)
    except WeightsMismatch:  # torch reads more number formats and reports mismatches in detail
        from lidar_perception.detectors.pointpillars.network import load_network

        header, network = load_network(path)
        return header, SparseNetwork(header.config, to_arrays(network))

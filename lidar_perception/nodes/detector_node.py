"""Base class of detector nodes, which load a network, run it and report problems."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lidar_perception.detectors.contract import DetectionResult, join_problems
from lidar_perception.detectors.custom import find_reference, load_custom_detector
from lidar_perception.detectors.params import NetworkParams
from lidar_perception.nodes.diagnostics import OK, WARN
from lidar_perception.nodes.interfaces import CLOUD
from lidar_perception.nodes.managed import ManagedNode
from lidar_perception.nodes.outputs import DetectionOutputs
from lidar_perception.nodes.sensor_check import SensorCheck
from lidar_perception.params import DetectionNodeParams
from lidar_perception.runs.compiling import lock_compilation, report_compilation
from lidar_perception.runs.machine import count_cores
from lidar_perception.runs.threads import set_thread_count
from lidar_perception.types import InputError, PointCloud
from lidar_perception.wire.messages import read_cluster_ids, read_column
from msg_utils.stamps import to_ns


@dataclass(frozen=True)
class NetworkLoader:
    """Functions that load the detector of a node.

    Attributes:
        group: name of the detector's parameter group, a NetworkParams.
        steps: names of the steps whose times are published.
        find_weights: returns the path of the weights for the parameters of the group, without
            importing torch; raises InputError if the file does not exist.
        load: loads a detector from (weights, device, parameters of the node) and warms it up;
            raises InputError if the weights cannot be used.
        describe_network: returns the name of a network, given its configuration.
        allows_custom: True if the parameter weights may be the module:Class of a custom detector.
    """

    group: str
    steps: tuple[str, ...]
    find_weights: Callable[[Any], Path]
    load: Callable[[Path, str, Any], Any]
    describe_network: Callable[[Any], str]
    allows_custom: bool = False


class DetectorNode(ManagedNode):
    """Detects objects with a network: ~/input/points -> ~/output/detections.

    Without a network, the node publishes nothing, because an empty array would mean an empty scene.
    """

    def __init__(self, name: str, params: Any, loader: NetworkLoader, **options: Any):
        super().__init__(name, params, DetectionNodeParams(), **options)
        self.loader = loader

    def configure(self) -> None:
        self.sensor = SensorCheck(self)
        self.results = DetectionOutputs(self, self.loader.steps)
        weights = self._get_network_params(self.params).weights
        if self.loader.allows_custom and (reference := find_reference(weights)):
            self._load_custom_detector(reference)
        else:
            self._load_network()
        self.inputs.subscribe("points", CLOUD, self.on_points)

    def _get_network_params(self, params: Any) -> NetworkParams:
        network_params: NetworkParams = getattr(params, self.loader.group)
        return network_params

    def _set_detector(self, detector: Any, name: str) -> None:
        self.detector = detector
        self.diagnostics.counts.update(network=f"{name}, {' '.join(detector.classes)}", device=detector.device)

    def _load_custom_detector(self, reference: str) -> None:
        group = self.loader.group
        network_params: Any = getattr(self.params, group)
        detector = load_custom_detector(
            reference, network_params.device, network_params.range, params=self.params, group=group
        )
        self._set_detector(detector, reference)

    def _load_network(self) -> None:
        with report_compilation(self.get_logger().info, full_detector=True):
            detector = self._load_on_device()
        self._set_detector(detector, self.loader.describe_network(detector.networks[0].config))
        if detector.warning:  # not reported as the state, which shows what the node waits for
            self.diagnostics.counts["doubt"] = detector.warning
            self.get_logger().warning(detector.warning)
        if detector.fallback:
            self.diagnostics.report(WARN, detector.fallback)

    def _load_on_device(self) -> Any:
        """Load the detector, on the CPU if CUDA is missing and cpu_fallback is set."""
        network_params, fallback = self._get_network_params(self.params), None
        weights = self.loader.find_weights(network_params)
        from lidar_perception.detectors.devices import find_device

        # main.py sets the default to one thread.
        set_thread_count(network_params.threads or count_cores())
        device = network_params.device
        if device.startswith("cuda") and network_params.cpu_fallback:
            try:
                find_device(device)
            except InputError as error:
                device, fallback = "cpu", f"{error}; falling back to the CPU"
        with lock_compilation(self.get_logger().info):
            detector = self.loader.load(weights, device, self.params)
        detector.fallback = detector.fallback or fallback
        return detector

    def on_points(self, msg: Any) -> None:
        with self.diagnostics.measure_frame(to_ns(msg.header.stamp)):
            frame, indices, params = self.sensor.read_frame(msg, with_intensity=True)
            ground, clusters = read_column(msg, "ground", indices), read_cluster_ids(msg, indices)
            network_params = self._get_network_params(params)
            detector = self.detector.with_params(self._lower_thresholds(params, network_params))
            result = detector(
                frame,
                ground=None if ground is None else ground > 0,
                cluster_ids=None if clusters is None else clusters[0],
            )
            tracked = result.detections  # includes weak detections for the tracker
            if self.results.tracks is not None:
                result = replace(result, detections=tracked[network_params.scores.passes(tracked)])
            tracking_problem = self.results.publish(
                msg.header, result.detections, result.timings, frame.xyz, tracked=tracked
            )
        self._diagnose(frame, result, params, tracking_problem)

    def _lower_thresholds(self, params: Any, network_params: NetworkParams) -> Any:
        """Return params with lower score thresholds if a tracker uses the weak detections."""
        if self.results.tracks is None:
            return params
        low = network_params.scores.limit_to(self.node_params.tracking.min_score)
        return replace(params, **{self.loader.group: replace(network_params, scores=low)})

    def _diagnose(self, frame: PointCloud, result: DetectionResult, params: Any, tracking_problem: str | None) -> None:
        # result.problem includes problems of the intensity.
        problem = join_problems(
            result.problem, self.sensor.check_height(frame, params.ground.sensor_pose), tracking_problem
        )
        self.diagnostics.counts.update(detections=len(result.detections), device=self.detector.device)
        self.diagnostics.counts["best scores"] = " ".join(f"{name} {score:.2f}" for name, score in result.best.items())
        if problem:
            self.diagnostics.report(WARN, problem)
        else:
            self.diagnostics.report(
                OK,
                "detecting"
                if len(result.detections)
                else f"nothing detected: every score is below its threshold in {self.loader.group}.scores",
            )

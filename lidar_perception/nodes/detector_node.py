"""Base class of the nodes that detect objects with a network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

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


class DetectorNode(ManagedNode):
    """Detects objects with a network: ~/input/points -> ~/output/detections.

    Without a network, the node publishes nothing, because an empty array would mean an empty scene.

    Attributes:
        group: name of the detector and of its parameter group, a NetworkParams.
        steps: names of the steps whose times are published.
        allows_custom: True if the parameter weights may be the module:Class of a custom detector.
    """

    group: ClassVar[str]
    steps: ClassVar[tuple[str, ...]]
    detector: Any
    allows_custom: ClassVar[bool] = False

    def __init__(self, params: Any, **options: Any):
        super().__init__(f"{self.group}_detector", params, DetectionNodeParams(), **options)

    def find_weights(self) -> Path:
        """Return the path of the weights, without importing torch.

        Raises:
            InputError: the file does not exist.
        """
        raise NotImplementedError

    def load_detector(self, weights: Path, device: str) -> Any:
        """Load the detector with the parameters of the node, and warm it up.

        Raises:
            InputError: the weights cannot be used.
        """
        raise NotImplementedError

    def describe_network(self, config: Any) -> str:
        """Return the name of the network with this configuration."""
        raise NotImplementedError

    def configure(self) -> None:
        self.sensor = SensorCheck(self)
        self.results = DetectionOutputs(self, self.steps)
        network_params: Any = self._get_network_params(self.params)
        fallback = None
        if self.allows_custom and (reference := find_reference(network_params.weights)):
            self.detector = load_custom_detector(
                reference, network_params.device, network_params.range, params=self.params, group=self.group
            )
            name = reference
        else:
            self.detector = self._load_network()
            name = self.describe_network(self.detector.networks[0].config)
            fallback = self.detector.fallback
        self.diagnostics.counts.update(
            network=f"{name}, {' '.join(self.detector.classes)}", device=self.detector.device
        )
        if fallback:
            self.diagnostics.report(WARN, fallback)
        self.inputs.subscribe("points", CLOUD, self.on_points)

    def _get_network_params(self, params: Any) -> NetworkParams:
        network_params: NetworkParams = getattr(params, self.group)
        return network_params

    def _load_network(self) -> Any:
        with report_compilation(self.get_logger().info, full_detector=True):
            detector = self._load_on_device()
        if detector.warning:  # not reported as the state, which shows what the node waits for
            self.diagnostics.counts["doubt"] = detector.warning
            self.get_logger().warning(detector.warning)
        return detector

    def _load_on_device(self) -> Any:
        """Load the detector, on the CPU if CUDA is missing and cpu_fallback is set."""
        network_params, fallback = self._get_network_params(self.params), None
        weights = self.find_weights()
        from lidar_perception.detectors.devices import find_device

        # This replaces the limit of one thread per process from main.py.
        set_thread_count(network_params.threads or count_cores())
        device = network_params.device
        if device.startswith("cuda") and network_params.cpu_fallback:
            try:
                find_device(device)
            except InputError as error:
                device, fallback = "cpu", f"{error}; falling back to the CPU"
        with lock_compilation(self.get_logger().info):
            detector = self.load_detector(weights, device)
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
            all_detections = result.detections  # with tracking, also those below the score thresholds
            if self.results.tracks is not None:
                has_passed = network_params.scores.passes(all_detections)
                result = replace(result, detections=all_detections[has_passed])
            tracking_problem = self.results.publish(
                msg.header, result.detections, result.timings, frame.xyz, tracker_input=all_detections
            )
        self._diagnose(frame, result, params, tracking_problem)

    def _lower_thresholds(self, params: Any, network_params: NetworkParams) -> Any:
        """Return params with lower score thresholds if a tracker uses the weak detections."""
        if self.results.tracks is None:
            return params
        low = network_params.scores.limit_to(self.node_params.tracking.min_score)
        return replace(params, **{self.group: replace(network_params, scores=low)})

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
                else f"nothing detected: every score is below its threshold in {self.group}.scores",
            )

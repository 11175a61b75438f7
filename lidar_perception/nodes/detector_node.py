"""Base class of the detector nodes: loading, running and diagnosing a network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

from lidar_perception.detectors.contract import DetectionResult, join_problems
from lidar_perception.detectors.params import NetworkParams
from lidar_perception.nodes.managed import ManagedNode
from lidar_perception.nodes.outputs import DetectionOutputs
from lidar_perception.nodes.runtime import CLOUD, OK, WARN
from lidar_perception.nodes.sensor_check import SensorCheck
from lidar_perception.runs.compiling import lock_compilation, report_compilation
from lidar_perception.runs.machine import count_cores
from lidar_perception.runs.threads import set_thread_count
from lidar_perception.types import InputError, PointCloud
from lidar_perception.wire.messages import read_cluster_ids, read_column
from msg_utils.stamps import to_ns


class DetectorNode(ManagedNode):
    """~/input/points -> ~/output/detections.

    A subclass names the parameter group of its network, finds the weights and loads the detector.
    Without a network the node publishes nothing, as an empty array would mean an empty scene.
    """

    group: ClassVar[str]  # name of the parameter group (a NetworkParams)
    steps: ClassVar[tuple[str, ...]]  # names of the timed steps

    def configure(self) -> None:
        self.sensor = SensorCheck(self)
        self.outputs = DetectionOutputs(self, self.steps)
        with report_compilation(self.get_logger().info, whole_detector=True):
            self.detector = self._load_detector()
        name = self.describe_network(self.detector.networks[0].config)
        self.counts.update(network=f"{name}, {' '.join(self.detector.classes)}", device=self.detector.device)
        if self.detector.warning:  # not the state, which tells what the node waits for
            self.counts["doubt"] = self.detector.warning
            self.get_logger().warning(self.detector.warning)
        if self.detector.fallback:
            self.report(WARN, self.detector.fallback)
        self.input("points", CLOUD, self.on_points)

    def weights(self) -> Path:
        """Return the path of the weights, without importing torch.

        Raises:
            InputError: the file does not exist.
        """
        raise NotImplementedError

    def load(self, weights: Path, device: str) -> Any:
        """Load a detector and warm it up.

        Raises:
            InputError: the weights cannot be used.
        """
        raise NotImplementedError

    def describe_network(self, config: Any) -> str:
        """Return the name of a network for the diagnostics."""
        raise NotImplementedError

    def _load_detector(self) -> Any:
        """Load the detector; on the CPU if CUDA is missing and cpu_fallback is set."""
        network_params, fallback = getattr(self.params, self.group), None
        weights = self.weights()
        from lidar_perception.detectors.devices import find_device

        # One thread is the default, by the environment that main.py sets.
        set_thread_count(network_params.threads or count_cores())
        device = network_params.device
        if device.startswith("cuda") and network_params.cpu_fallback:
            try:
                find_device(device)
            except InputError as error:
                device, fallback = "cpu", f"{error}; falling back to the CPU"
        with lock_compilation(self.get_logger().info):
            detector = self.load(weights, device)
        detector.fallback = detector.fallback or fallback
        return detector

    def on_points(self, msg: Any) -> None:
        with self.frame(to_ns(msg.header.stamp)):
            frame, indices, params = self.sensor.read_frame(msg, with_intensity=True)
            ground, clusters = read_column(msg, "ground", indices), read_cluster_ids(msg, indices)
            network_params = getattr(params, self.group)
            detector = self.detector.with_params(self._lower_thresholds(params, network_params))
            result = detector(
                frame,
                ground=None if ground is None else ground > 0,
                cluster_ids=None if clusters is None else clusters[0],
            )
            weak = result.detections
            if self.outputs.tracks is not None:
                result = replace(result, detections=weak[network_params.scores.passes(weak)])
            tracking_problem = self.outputs.publish(msg.header, result.detections, result.timings, frame.xyz, weak=weak)
        self._diagnose(frame, result, params, tracking_problem)

    def _lower_thresholds(self, params: Any, network_params: NetworkParams) -> Any:
        """Return params with thresholds that include the weak detections for the tracker."""
        if self.outputs.tracks is None:
            return params
        low = network_params.scores.with_maximum(self.node_params.tracking.min_score)
        return replace(params, **{self.group: replace(network_params, scores=low)})

    def _diagnose(self, frame: PointCloud, result: DetectionResult, params: Any, tracking_problem: str | None) -> None:
        # The problem of the detector includes those of the intensity.
        problem = join_problems(
            result.problem, self.sensor.check_height(frame, params.ground.sensor_pose), tracking_problem
        )
        self.counts.update(detections=len(result.detections), device=self.detector.device)
        self.counts["best scores"] = " ".join(f"{name} {score:.2f}" for name, score in result.best.items())
        if problem:
            self.report(WARN, problem)
        else:
            self.report(
                OK,
                "detecting"
                if len(result.detections)
                else f"nothing detected: every score is below its threshold in {self.group}.scores",
            )

"""What the nodes with a network share: how it is loaded, run, and spoken of."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

from lidar_perception.detectors.contract import Found, joined
from lidar_perception.detectors.params import NetworkParams
from lidar_perception.nodes.managed import ManagedNode
from lidar_perception.nodes.outputs import DetectionOutputs
from lidar_perception.nodes.runtime import CLOUD, OK, WARN
from lidar_perception.nodes.sensor_check import SensorCheck
from lidar_perception.runs.compiling import lock_compilation, report_compilation
from lidar_perception.runs.machine import count_cores
from lidar_perception.types import InputError, LidarFrame
from lidar_perception.wire.messages import read_cluster_ids, read_column
from msg_utils.stamps import to_ns


class DetectorNode(ManagedNode):
    """~/input/points -> ~/output/detections. A node names its network's group of parameters, finds
    its weights and loads the detector.

    Without a network it publishes nothing, as an empty array would mean that nothing is there.
    """

    group: ClassVar[str]  # of the parameters, a NetworkParams
    steps: ClassVar[tuple[str, ...]]  # that are timed

    def configure(self) -> None:
        self.sensor = SensorCheck(self)
        self.outputs = DetectionOutputs(self, self.steps)
        with report_compilation(self.get_logger().info, whole_detector=True):
            self.detector = self._loaded()
        name = self.name_of(self.detector.networks[0].config)
        self.counts.update(network=f"{name}, {' '.join(self.detector.classes)}",
                           device=str(self.detector.device))
        if self.detector.warning:  # beside the state, which says what the node waits for
            self.counts["doubt"] = self.detector.warning
            self.get_logger().warning(self.detector.warning)
        if self.detector.fallback:
            self.report(WARN, self.detector.fallback)
        self.input("points", CLOUD, self.on_points)

    def weights(self) -> Path:
        """The file of the weights, found without loading torch. InputError if there is none."""
        raise NotImplementedError

    def load(self, weights: Path, device: str) -> Any:
        """The detector with these weights, warmed up. InputError if they cannot be used."""
        raise NotImplementedError

    def name_of(self, config: Any) -> str:
        """What a network's config is called."""
        raise NotImplementedError

    def _loaded(self) -> Any:
        """The detector that the parameters ask for; on the CPU if CUDA is asked for and not there,
        and the CPU may take over."""
        chosen, missing = getattr(self.params, self.group), None
        weights = self.weights()
        import torch  # takes seconds, so it waits until there are weights

        from lidar_perception.detectors.devices import chosen_device
        # 0 leaves torch with what main.py sets in the environment, which is one.
        torch.set_num_threads(chosen.threads or count_cores())
        device = chosen.device
        if device.startswith("cuda") and chosen.cpu_fallback:
            try:
                chosen_device(device)
            except InputError as error:
                device, missing = "cpu", f"{error}; the CPU is used"
        with lock_compilation(self.get_logger().info):
            detector = self.load(weights, device)
        detector.fallback = detector.fallback or missing
        return detector

    def on_points(self, msg: Any) -> None:
        with self.frame(to_ns(msg.header.stamp)):
            frame, indices, params = self.sensor.frame(msg, with_intensity=True)
            ground, clusters = read_column(msg, "ground", indices), read_cluster_ids(msg, indices)
            own = getattr(params, self.group)
            detector = self.detector.with_params(self._with_weak(params, own))
            found = detector(frame, ground=None if ground is None else ground > 0,
                             cluster_ids=None if clusters is None else clusters[0])
            weak = found.detections
            if self.outputs.tracks is not None:
                found = replace(found, detections=weak[own.scores.passed(weak)])
            untracked = self.outputs.publish(msg.header, found.detections, found.timings, frame.xyz,
                                             weak=weak)
        self._diagnose(frame, found, params, untracked)

    def _with_weak(self, params: Any, own: NetworkParams) -> Any:
        """params, with thresholds that let through what a tracker needs as well."""
        if self.outputs.tracks is None:
            return params
        low = own.scores.at_most(self.robot.tracking.min_score)
        return replace(params, **{self.group: replace(own, scores=low)})

    def _diagnose(self, frame: LidarFrame, found: Found, params: Any,
                  untracked: str | None) -> None:
        # The detector's own problem names the intensity, too.
        problem = joined(found.problem, self.sensor.height_problem(
            frame, params.ground.sensor_pose), untracked)
        self.counts.update(detections=len(found.detections), device=str(self.detector.device))
        self.counts["best scores"] = " ".join(
            f"{name} {score:.2f}" for name, score in found.best.items())
        if problem:
            self.report(WARN, problem)
        else:
            self.report(OK, "detecting" if len(found.detections) else "nothing detected: every "
                        f"score is below its threshold in {self.group}.scores")

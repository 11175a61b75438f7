"""~/input/points -> ~/output/detections: cars, pedestrians and cyclists by EG-PointPillars."""

from __future__ import annotations

import os
import traceback
from typing import TYPE_CHECKING, Any

import numpy as np

from lidar_perception.detection.detector_params import STEPS, DetectorParams
from lidar_perception.detection.weights_file import weights_file
from lidar_perception.messages import column, to_frame
from lidar_perception.nodes.main import one_at_a_time
from lidar_perception.nodes.outputs import DetectionOutputs
from lidar_perception.nodes.runtime import CLOUD, ERROR, OK, WARN, LidarNode
from lidar_perception.nodes.sensor_check import SensorCheck
from lidar_perception.types import Detections, InputError, LidarFrame
from msg_utils.stamps import to_ns

if TYPE_CHECKING:
    from lidar_perception.detection.detector import Detector


class PointPillarsDetector(LidarNode):
    """Loads the network before it subscribes. Without one it says why and publishes nothing, as an
    empty array would mean that nothing is there."""

    def __init__(self, **options: Any):
        super().__init__("pointpillars_detector", DetectorParams(), **options)
        self.sensor = SensorCheck(self)
        self.outputs = DetectionOutputs(self, STEPS)
        self.report(WARN, "loading the network")
        self.detector = self._loaded()
        self.input("points", CLOUD, self.on_points)

    def _loaded(self) -> Detector | None:
        try:
            detector = load(self.params)
        except InputError as error:
            self.report(ERROR, f"nothing is detected: {error}")
            return None
        except Exception as error:  # of torch and its drivers: the node lives to tell
            self.get_logger().error(traceback.format_exc())
            self.report(ERROR, "nothing is detected, as the network cannot be loaded: "
                        f"{type(error).__name__}: {error}")
            return None
        config = detector.config
        self.counts.update(network=f"{config.version} {config.size}, "
                           f"{' '.join(config.classes)}", device=str(detector.device))
        self.report(WARN, detector.fallback or "waiting for input")
        return detector

    def on_points(self, msg: Any) -> None:
        if self.detector is None:
            return
        with self.frame(to_ns(msg.header.stamp)):
            frame, places = to_frame(msg, self.params.input.intensity_max)
            ground, ids = column(msg, "ground", places), column(msg, "cluster_id", places)
            with np.errstate(invalid="ignore"):  # NaN in a column of floats is no cluster
                ids = None if ids is None else ids.astype(np.int32)
            self.detector.params = self.params
            found = self.detector(frame, None if ground is None else ground > 0, ids)
            self.outputs.publish(msg.header, found, self.detector.ms)
        self._diagnose(frame, found)

    def _diagnose(self, frame: LidarFrame, found: Detections) -> None:
        problem = self.detector.problem or self.sensor.problem(frame)
        self.counts.update(detections=len(found), device=str(self.detector.device))
        self.counts["best scores"] = " ".join(
            f"{name} {score:.2f}" for name, score in self.detector.best.items())
        if problem:
            self.report(WARN, problem)
        else:
            self.report(OK, "detecting" if len(found) else
                        "nothing found: every score is below its threshold in detection.scores")


def load(params: DetectorParams) -> Detector:
    """The detector that the parameters ask for, warmed up; on the CPU if CUDA is asked for and not
    there, and the CPU may take over. InputError if there is none."""
    chosen, missing = params.detection, None
    weights = weights_file(chosen)
    import torch  # takes seconds, so it waits until there are weights

    from lidar_perception.detection.detector import chosen_device, load_detector
    # 0 leaves torch with what main.py sets in the environment, which is one.
    torch.set_num_threads(chosen.threads or len(os.sched_getaffinity(0)))
    device = chosen.device
    if device.startswith("cuda") and chosen.cpu_fallback:
        try:
            chosen_device(device)
        except InputError as error:
            device, missing = "cpu", f"{error}; the CPU is used"
    with one_at_a_time():
        detector = load_detector(weights, device, params)
    detector.fallback = detector.fallback or missing
    return detector

"""Node that scores detections against ground truth.

It computes scores by centre distance while it runs, and KITTI's average precision when it ends.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Any

from rclpy.qos import QoSProfile

from lidar_perception.camera import Calibration
from lidar_perception.classes import CAR, DETECTED
from lidar_perception.nodes.diagnostics import ERROR, OK, WARN, Problem
from lidar_perception.nodes.interfaces import LATCHED, MARKERS, SENSOR_DATA
from lidar_perception.nodes.runtime import LidarNode
from lidar_perception.params import EvaluatorParams
from lidar_perception.runs.compiling import lock_compilation
from lidar_perception.runs.files import write_text
from lidar_perception.scoring.centres.report import CandidateReport, CandidateResult
from lidar_perception.scoring.detections import FrameDetections
from lidar_perception.scoring.kitti.camera_objects import select_in_image, to_scored_labels
from lidar_perception.scoring.kitti.report import DetectionReport
from lidar_perception.types import CLASSES, PEDESTRIAN, Detections, GroundTruth, InputError, make_unknown_name_error
from lidar_perception.wire.messages import read_calibration, to_detections, to_truth
from msg_utils.markers import MarkedObjects, from_marker_array

WRITE_PERIOD_S = 5.0
MAX_INCOMPLETE_FRAMES = 100
MAX_DONE_STAMPS = 100_000  # enough for 2.8 hours at 10 Hz; uses 10 MB
MAX_AP_FRAMES = 10_000  # maximum number of frames stored for the average precision
LOSSLESS_QOS = QoSProfile(depth=1000)  # QoS of small messages that must not be lost
TRUTH = "ground_truth"


class Evaluator(LidarNode):
    """Scores each frame once its ground truth and the detections of all stages have arrived.

    Messages are matched by header.stamp. A frame counts once, even if its bag loops. Incomplete
    frames count as lost, never as missed objects. With a camera, labels and detections outside its
    image are ignored, because KITTI has no labels there.
    """

    writes_files = True

    def __init__(self, **options: Any):
        super().__init__("evaluator", EvaluatorParams(), **options)
        self.frame_inputs = (TRUTH, *self.params.stages)
        _check_params(self.params)
        # Pedestrian comes first because its scores are at the top level of the file.
        self.results = {
            name: CandidateReport()
            for name in sorted(self.params.classes, key=lambda name: name != CLASSES[PEDESTRIAN])
        }
        self.precision = {stage: DetectionReport() for stage in self.params.stages}
        self.camera_info: Any = None
        self.extrinsics: Any = None
        self.calibration: Calibration | None = None  # cached until a new camera message arrives
        self.incomplete_frames: dict[int, dict[str, MarkedObjects]] = {}  # stamp -> input -> objects
        self.done_stamps: dict[int, None] = {}  # ordered set of the stamps of scored and lost frames
        self.write_error: str | None = None  # reason why the file cannot be written
        self.frame_mismatch: str | None = None  # the frame_ids of the last frame if they differ
        self.diagnostics.counts.update(incomplete=0, repeated=0)
        self.diagnostics.sources.append(self)
        with lock_compilation(self.get_logger().info):
            _warm_up()  # before the inputs are created, because bag_player waits for these
        for name in self.frame_inputs:
            self.inputs.subscribe(name, MARKERS, lambda m, n=name: self._add(n, m), LOSSLESS_QOS)
        for topic, type_name in (
            ("camera_info", "sensor_msgs/msg/CameraInfo"),
            ("extrinsics", "geometry_msgs/msg/TransformStamped"),
        ):
            self.inputs.subscribe(topic, type_name, partial(self._on_camera, topic), LATCHED, SENSOR_DATA)
        for topic in self.params.timing:
            *_, node, _, quantity = topic.split("/")  # .../NODE/debug/QUANTITY
            name = node if quantity == "processing_time_ms" else quantity.removesuffix("_ms")
            self.inputs.subscribe(
                topic, "std_msgs/msg/Float64", lambda m, n=name: self._add_time(n, m.data), LOSSLESS_QOS, private=False
            )
        self.add_steady_timer(WRITE_PERIOD_S, self.write)

    def _add_time(self, name: str, ms: float) -> None:
        if isfinite(ms):
            next(iter(self.results.values())).update_times({name: ms})

    def _add(self, name: str, msg: Any) -> None:
        objects = from_marker_array(msg)
        if not msg.markers:
            raise InputError(
                "an empty MarkerArray has no stamp, so it cannot be matched; send a "
                "DELETE marker with the header of the frame"
            )
        stamp = objects.stamp_ns
        if stamp in self.done_stamps:  # the bag has restarted, or the message is late
            self.diagnostics.counts["repeated"] += 1
            return
        frame = self.incomplete_frames.setdefault(stamp, {})
        frame[name] = objects
        if len(frame) == len(self.frame_inputs):
            self._finish(stamp)
            with self.diagnostics.measure_frame(stamp):
                self._score(frame)
            self.diagnostics.report(
                OK,
                "scoring"
                if any(result.frames for result in self.results.values())
                else "no frame with a Pedestrian yet",
            )
        while len(self.incomplete_frames) > MAX_INCOMPLETE_FRAMES:
            oldest_stamp = next(iter(self.incomplete_frames))
            missing_inputs = [n for n in self.frame_inputs if n not in self.incomplete_frames[oldest_stamp]]
            self._finish(oldest_stamp)
            self.diagnostics.counts["incomplete"] += 1
            self.diagnostics.report(
                WARN,
                f"some frames are not scored because they have no message on "
                f"{self._join_topics(missing_inputs)} with the same header.stamp; stamps must be equal "
                "to the nanosecond",
            )

    def _finish(self, stamp: int) -> None:
        del self.incomplete_frames[stamp]
        self.done_stamps[stamp] = None
        if len(self.done_stamps) > MAX_DONE_STAMPS:
            del self.done_stamps[next(iter(self.done_stamps))]

    def _score(self, frame: dict[str, MarkedObjects]) -> None:
        truth, calibration = to_truth(frame[TRUTH]), self._read_calibration()
        stages = {s: to_scored_labels(to_detections(frame[s])) for s in self.params.stages}
        visible_truth, visible_objects = (
            (truth, stages)
            if calibration is None
            else (
                select_in_image(truth, calibration),
                {s: select_in_image(objects, calibration) for s, objects in stages.items()},
            )
        )
        for name, result in self.results.items():
            self._score_class(name, result, visible_truth, visible_objects)
        for stage, objects in stages.items():
            if len(self.precision[stage].frames) < MAX_AP_FRAMES:
                self.precision[stage].update(FrameDetections(str(frame[TRUTH].stamp_ns), truth, objects, calibration))
        names = {name: objects.frame_id for name, objects in frame.items()}
        self.frame_mismatch = (
            None
            if len({*names.values()}) == 1
            else ", ".join(f"{self._join_topics([n])} in '{frame_id}'" for n, frame_id in names.items())
        )

    def _score_class(
        self, name: str, result: CandidateReport, truth: GroundTruth, stages: dict[str, GroundTruth]
    ) -> None:
        class_id = CLASSES.index(name)
        suffix = "" if class_id == PEDESTRIAN else f", {name}"
        boxes = truth.select_class(class_id)
        if len(boxes) or suffix or not self.params.only_with_pedestrians:
            result.update(
                CandidateResult(boxes, {stage: objects.select_class(class_id) for stage, objects in stages.items()}, {})
            )
        self.diagnostics.counts[f"scored{suffix}"] = result.frames
        self.diagnostics.counts.update(
            {
                f"F1 of {stage}{suffix}": f"{score.make_rows()['all']['f1']:.3f}"
                for stage, score in result.scores.items()
            }
        )

    def _on_camera(self, name: str, msg: Any) -> None:
        setattr(self, name, msg)
        self.calibration = None

    def _read_calibration(self) -> Calibration | None:
        """Return the calibration of the camera, or None before its messages have arrived."""
        if self.camera_info is None or self.extrinsics is None:
            return None
        if self.calibration is None:
            self.calibration = read_calibration(self.camera_info, self.extrinsics)
        return self.calibration

    def _join_topics(self, names: Iterable[str]) -> str:
        return " and ".join(self.resolve_topic_name(f"~/input/{name}") for name in names)

    def values(self) -> dict[str, Any]:
        """Return the values for the diagnostics."""
        return {"waiting": len(self.incomplete_frames)}

    def problems(self) -> list[Problem]:
        """Return the present problems with their remedies."""
        problems: list[Problem] = []
        for name in self.frame_inputs:
            topic = self._join_topics([name])
            if (count := self.count_publishers(topic)) > 1:
                message = f"{count} publishers on {topic}: only the first array of a frame is used; remap all but one"
                problems.append((f"publishers of {name}", WARN, message))
        if self.frame_mismatch:
            message = f"the boxes are in different frames: {self.frame_mismatch}; publish them in one (target_frame)"
            problems.append(("frames", WARN, message))
        if self.write_error:
            problems.append(("file", ERROR, f"{self.write_error}; retrying every {WRITE_PERIOD_S:g} s"))
        return problems

    def write(self) -> None:
        """Write the scores so far to params.file, if it is set."""
        if self.params.file:
            self._write(self._compute_scores())

    def _compute_scores(self) -> dict[str, Any]:
        first, *others = self.results
        return {
            **self.results[first].compute(),
            "lost_frames": self.diagnostics.counts["incomplete"] + len(self.incomplete_frames),
            "classes": {name: self.results[name].compute() for name in others},
        }

    def _write(self, content: dict[str, Any]) -> None:
        try:
            write_text(self.params.file, json.dumps(content, indent=1))
            self.write_error = None
        except InputError as error:
            self.write_error = str(error)

    def close(self) -> None:
        precision = {
            stage: {name: rows for name, rows in report.compute()["ap"].items() if name in self.results}
            for stage, report in self.precision.items()
        }
        for name, result in self.results.items():
            for stage, score in result.scores.items():
                row, ap = score.make_rows()["all"], precision[stage].get(name, {})
                bev = ap.get("bev_relaxed", {}).get("moderate")
                self.get_logger().info(
                    f"{name}, {stage}, within 1 m: {row['tp']} true positives, {row['fp']} false positives, "
                    f"{row['fn']} misses, F1 {100 * row['f1']:.1f}" + (f"; BEV AP {bev['r40']:.1f}" if bev else "")
                )
        if self.params.file:
            self._write({**self._compute_scores(), "ap": precision})
        if self.write_error:
            raise InputError(f"the scores are lost: {self.write_error}")


def _warm_up() -> None:
    """Score one object to trigger JIT compilation."""
    truth = GroundTruth.of([[10, 0, 0, 4, 2, 1.5, 0]], [CAR])
    report = DetectionReport()
    report.update(FrameDetections("", truth, Detections.of(truth.boxes, truth.class_ids, [1.0])))
    report.compute()


def _check_params(params: EvaluatorParams) -> None:
    """Raise InputError for values that prevent scoring or writing the scores."""
    if TRUTH in params.stages or len({*params.stages}) < len(params.stages) or not params.stages:
        raise InputError(f"stages: {list(params.stages)} must be distinct names of inputs other than {TRUTH}")
    if not params.classes:
        raise InputError(f"classes: choose one or more of {', '.join(DETECTED)}")
    for name in params.classes:
        if name not in DETECTED:
            raise make_unknown_name_error("class", name, [*DETECTED])
    if invalid_topics := [topic for topic in params.timing if topic.count("/") < 2]:
        raise InputError(f"timing: {invalid_topics[0]} does not have the form .../NODE/debug/NAME")
    if params.file and (
        Path(params.file).is_dir() or (Path(params.file).parent.exists() and not Path(params.file).parent.is_dir())
    ):
        raise InputError(f"file: {params.file} cannot be written; give the path of a file")

"""Node that scores detections against ground truth by the protocol of paper A."""

from __future__ import annotations

import json
from collections.abc import Iterable
from math import isfinite
from pathlib import Path
from typing import Any

from rclpy.qos import QoSProfile

from lidar_perception.nodes.reception import Problem
from lidar_perception.nodes.runtime import ERROR, MARKERS, OK, WARN, LidarNode
from lidar_perception.params import EvaluatorParams
from lidar_perception.runs.files import write_text
from lidar_perception.scoring.centres.report import CandidateReport, CandidateResult
from lidar_perception.types import PEDESTRIAN, InputError
from lidar_perception.wire.messages import to_detections, to_truth
from msg_utils.markers import MarkedObjects, from_marker_array

WRITE_PERIOD_S = 5.0
MAX_INCOMPLETE_FRAMES = 100
MAX_DONE_STAMPS = 100_000  # 2.8 hours at 10 Hz, 10 MB
LOSSLESS_QOS = QoSProfile(depth=1000)  # small messages, none of which may be lost
TRUTH = "ground_truth"


class Evaluator(LidarNode):
    """Scores each frame once its ground truth and the detections of all stages have arrived.

    Messages are matched by header.stamp. A frame counts once, even if its bag loops. Incomplete
    frames count as lost, never as missed objects.
    """

    writes_files = True

    def __init__(self, **options: Any):
        super().__init__("evaluator", EvaluatorParams(), **options)
        self.inputs_of_frame = (TRUTH, *self.params.stages)
        _check(self.params)
        self.result = CandidateReport()
        self.waiting: dict[int, dict[str, MarkedObjects]] = {}
        self.done: dict[int, None] = {}  # stamps of scored and lost frames, in order
        self.unwritten: str | None = None  # reason why the file is not written
        self.frame_mismatch: str | None = None  # of the last frame
        self.counts.update(incomplete=0, repeated=0)
        for name in self.inputs_of_frame:
            self.input(name, MARKERS, lambda m, n=name: self._add(n, m), LOSSLESS_QOS)
        for topic in self.params.timing:
            *_, node, _, what = topic.split("/")  # .../NODE/debug/WHAT
            name = node if what == "processing_time_ms" else what.removesuffix("_ms")
            self.input(topic, "std_msgs/msg/Float64", lambda m, n=name: self._add_time(n, m.data),
                       LOSSLESS_QOS, private=False)
        self.add_steady_timer(WRITE_PERIOD_S, self.write)

    def _add_time(self, name: str, ms: float) -> None:
        if isfinite(ms):
            self.result.update_times({name: ms})

    def _add(self, name: str, msg: Any) -> None:
        objects = from_marker_array(msg)
        if not msg.markers:
            raise InputError("an empty MarkerArray has no stamp, so it cannot be matched; send a "
                             "DELETE marker with the header of the frame")
        stamp = objects.stamp_ns
        if stamp in self.done:  # a repeated bag, or a late message
            self.counts["repeated"] += 1
            return
        frame = self.waiting.setdefault(stamp, {})
        frame[name] = objects
        if len(frame) == len(self.inputs_of_frame):
            self._finish(stamp)
            with self.frame(stamp):
                self._score(frame)
            self.report(OK, "scoring" if self.result.frames else "no frame with a Pedestrian yet")
        while len(self.waiting) > MAX_INCOMPLETE_FRAMES:
            oldest = next(iter(self.waiting))
            missing = [n for n in self.inputs_of_frame if n not in self.waiting[oldest]]
            self._finish(oldest)
            self.counts["incomplete"] += 1
            self.report(WARN, f"frames are not scored that have no message on "
                        f"{self._topics(missing)} with the same header.stamp; stamps must be equal "
                        "to the nanosecond")

    def _finish(self, stamp: int) -> None:
        del self.waiting[stamp]
        self.done[stamp] = None
        if len(self.done) > MAX_DONE_STAMPS:
            del self.done[next(iter(self.done))]

    def _score(self, frame: dict[str, MarkedObjects]) -> None:
        truth = to_truth(frame[TRUTH]).of_class(PEDESTRIAN)
        if len(truth) or not self.params.only_with_pedestrians:
            detections = {s: to_detections(frame[s]) for s in self.params.stages}
            self.result.update(CandidateResult(truth, {s: d.boxes[d.class_ids == PEDESTRIAN]
                                                       for s, d in detections.items()}, {}))
        self.counts.update(scored=self.result.frames, **{
            f"F1 of {s}": f"{score.make_rows()['all']['f1']:.3f}"
            for s, score in self.result.scores.items()})
        names = {name: objects.frame_id for name, objects in frame.items()}
        self.frame_mismatch = None if len({*names.values()}) == 1 else ", ".join(
            f"{self._topics([n])} in '{frame_id}'" for n, frame_id in names.items())

    def _topics(self, names: Iterable[str]) -> str:
        return " and ".join(self.resolve_topic_name(f"~/input/{name}") for name in names)

    def _sources(self) -> list[Any]:
        return [*super()._sources(), self]

    def values(self) -> dict[str, Any]:
        """Return the values for the diagnostics."""
        return {"waiting": len(self.waiting)}

    def problems(self) -> list[Problem]:
        """Return problems that falsify the scores or prevent writing them, with their remedies."""
        found: list[Problem] = []
        for name in self.inputs_of_frame:
            topic = self._topics([name])
            if (count := self.count_publishers(topic)) > 1:
                found.append((f"publishers of {name}", WARN, f"{count} publishers on {topic}: only "
                              "the first array of a frame counts; remap all but one"))
        if self.frame_mismatch:
            found.append(("frames", WARN, f"the compared boxes are in different frames: "
                          f"{self.frame_mismatch}; publish both in one frame (target_frame)"))
        if self.unwritten:
            found.append(("file", ERROR, f"{self.unwritten}; retrying every "
                          f"{WRITE_PERIOD_S:g} s"))
        return found

    def write(self) -> None:
        """Write the scores so far to params.file, if it is set."""
        if self.params.file:
            content = self.result.compute()
            content["lost_frames"] = self.counts["incomplete"] + len(self.waiting)
            try:
                write_text(self.params.file, json.dumps(content, indent=1))
                self.unwritten = None
            except InputError as error:
                self.unwritten = str(error)

    def close(self) -> None:
        self.write()
        if self.unwritten:
            raise InputError(f"the scores are lost: {self.unwritten}")


def _check(params: EvaluatorParams) -> None:
    """Raise InputError for parameters that prevent scoring or writing."""
    if TRUTH in params.stages or len({*params.stages}) < len(params.stages) or not params.stages:
        raise InputError(f"stages: {list(params.stages)} must be distinct names of inputs "
                         f"other than {TRUTH}")
    if short := [topic for topic in params.timing if topic.count("/") < 2]:
        raise InputError(f"timing: {short[0]} is not of the form .../NODE/debug/WHAT")
    if params.file and (Path(params.file).is_dir() or (
            Path(params.file).parent.exists() and not Path(params.file).parent.is_dir())):
        raise InputError(f"file: {params.file} cannot be written; give the path of a file")

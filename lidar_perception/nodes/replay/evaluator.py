"""Scores detections against ground truth as they come; paper A's protocol."""

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

WRITE_PERIOD = 5.0  # seconds
WAITING_FRAMES = 100
REMEMBERED = 100_000  # stamps that are done: 2.8 hours at 10 Hz, and 10 MB
ALL_THAT_COME = QoSProfile(depth=1000)  # small messages, and every one counts
TRUTH = "ground_truth"


class Evaluator(LidarNode):
    """A frame is scored when its ground truth and every stage's detections have come, matched by
    header.stamp, once: a bag in a loop does not count twice. Frames that stay incomplete are
    counted as lost, never as misses."""

    writes_files = True

    def __init__(self, **options: Any):
        super().__init__("evaluator", EvaluatorParams(), **options)
        self.inputs_of_frame = (TRUTH, *self.params.stages)
        _check(self.params)
        self.result = CandidateReport()
        self.waiting: dict[int, dict[str, MarkedObjects]] = {}
        self.done: dict[int, None] = {}  # scored, or given up, in order
        self.unwritten: str | None = None  # why the file could not be written
        self.apart: str | None = None  # of the last frame: its parts are in frames that differ
        self.counts.update(incomplete=0, repeated=0)
        for name in self.inputs_of_frame:
            self.input(name, MARKERS, lambda m, n=name: self._add(n, m), ALL_THAT_COME)
        for topic in self.params.timing:
            *_, node, _, what = topic.split("/")  # .../NODE/debug/WHAT
            name = node if what == "processing_time_ms" else what.removesuffix("_ms")
            self.input(topic, "std_msgs/msg/Float64", lambda m, n=name: self._time(n, m.data),
                       ALL_THAT_COME, private=False)
        self.every(WRITE_PERIOD, self.write)

    def _time(self, name: str, ms: float) -> None:
        if isfinite(ms):
            self.result.update_times({name: ms})

    def _add(self, name: str, msg: Any) -> None:
        objects = from_marker_array(msg)
        if not msg.markers:
            raise InputError("an empty MarkerArray has no stamp, so it cannot be matched; send a "
                             "DELETE marker with the header of the frame")
        stamp = objects.stamp_ns
        if stamp in self.done:  # a bag that is played again, or what comes too late
            self.counts["repeated"] += 1
            return
        frame = self.waiting.setdefault(stamp, {})
        frame[name] = objects
        if len(frame) == len(self.inputs_of_frame):
            self._end(stamp)
            with self.frame(stamp):
                self._score(frame)
            self.report(OK, "scoring" if self.result.frames else "no frame with a Pedestrian yet")
        while len(self.waiting) > WAITING_FRAMES:
            oldest = next(iter(self.waiting))
            missing = [n for n in self.inputs_of_frame if n not in self.waiting[oldest]]
            self._end(oldest)
            self.counts["incomplete"] += 1
            self.report(WARN, f"frames are left out that have nothing on {self._topics(missing)} "
                        "with their header.stamp; stamps must be equal to the nanosecond")

    def _end(self, stamp: int) -> None:
        del self.waiting[stamp]
        self.done[stamp] = None
        if len(self.done) > REMEMBERED:
            del self.done[next(iter(self.done))]

    def _score(self, frame: dict[str, MarkedObjects]) -> None:
        truth = to_truth(frame[TRUTH]).of_class(PEDESTRIAN)
        if len(truth) or not self.params.only_with_pedestrians:
            found = {s: to_detections(frame[s]) for s in self.params.stages}
            self.result.update(CandidateResult(truth, {s: d.boxes[d.class_ids == PEDESTRIAN]
                                                       for s, d in found.items()}, {}))
        self.counts.update(scored=self.result.frames, **{
            f"F1 of {s}": f"{score.table()['all']['f1']:.3f}"
            for s, score in self.result.scores.items()})
        names = {name: objects.frame_id for name, objects in frame.items()}
        self.apart = None if len({*names.values()}) == 1 else ", ".join(
            f"{self._topics([n])} in '{frame_id}'" for n, frame_id in names.items())

    def _topics(self, names: Iterable[str]) -> str:
        return " and ".join(self.resolve_topic_name(f"~/input/{name}") for name in names)

    def _sources(self) -> list[Any]:
        return [*super()._sources(), self]

    def values(self) -> dict[str, Any]:
        """For the diagnostics."""
        return {"waiting": len(self.waiting)}

    def problems(self) -> list[Problem]:
        """What makes scores wrong, or keeps them from being written, with the remedy."""
        found: list[Problem] = []
        for name in self.inputs_of_frame:
            topic = self._topics([name])
            if (count := self.count_publishers(topic)) > 1:
                found.append((f"publishers of {name}", WARN, f"{count} publishers on {topic}: the "
                              "array of a frame that comes first is taken; remap all but one"))
        if self.apart:
            found.append(("frames", WARN, f"boxes are compared that are in other frames: "
                          f"{self.apart}; give both in one (target_frame)"))
        if self.unwritten:
            found.append(("file", ERROR, f"{self.unwritten}; it is tried again every "
                          f"{WRITE_PERIOD:g} s"))
        return found

    def write(self) -> None:
        """The scores so far, to the file that is asked for."""
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
    """InputError for parameters with which nothing could ever be scored or written."""
    if TRUTH in params.stages or len({*params.stages}) < len(params.stages) or not params.stages:
        raise InputError(f"stages: {list(params.stages)} must be names of inputs, each once, and "
                         f"not {TRUTH}")
    if short := [topic for topic in params.timing if topic.count("/") < 2]:
        raise InputError(f"timing: {short[0]} is no .../NODE/debug/WHAT")
    if params.file and (Path(params.file).is_dir() or (
            Path(params.file).parent.exists() and not Path(params.file).parent.is_dir())):
        raise InputError(f"file: {params.file} cannot be written; name a file in a folder")

"""Scores detections against ground truth as they come; paper A's protocol."""

from __future__ import annotations

import json
from typing import Any

from lidar_perception.nodes.runtime import MARKERS, OK, RELIABLE, WARN, LidarNode
from lidar_perception.params import EvaluatorParams
from lidar_perception.runs.files import write_text
from lidar_perception.scoring.centres.report import CandidateReport, CandidateResult
from lidar_perception.types import PEDESTRIAN, InputError
from lidar_perception.wire.messages import to_detections, to_truth
from msg_utils.markers import from_marker_array

WRITE_PERIOD = 5.0  # seconds
WAITING_FRAMES = 100
REMEMBERED = 100_000  # stamps that are not scored again: 2.8 hours at 10 Hz, and 10 MB


class Evaluator(LidarNode):
    """A frame is scored when its ground truth and every stage's detections have come, matched by
    header.stamp, once: a bag in a loop does not count twice. Frames that stay incomplete are
    counted as lost, never as misses."""

    def __init__(self, **options: Any):
        super().__init__("evaluator", EvaluatorParams(), **options)
        self.result = CandidateReport()
        self.waiting: dict[int, dict[str, Any]] = {}
        self.scored: dict[int, None] = {}  # in order
        self.counts["incomplete"] = 0
        self.input("ground_truth", MARKERS, lambda m: self._add("truth", m), RELIABLE)
        for stage in self.params.stages:
            self.input(stage, MARKERS, lambda m, s=stage: self._add(s, m), RELIABLE)
        for topic in self.params.timing:
            *_, node, _, what = topic.split("/")  # .../NODE/debug/WHAT
            name = node if what == "processing_time_ms" else what.removesuffix("_ms")
            self.input(topic, "std_msgs/msg/Float64",
                       lambda m, n=name: self.result.update_times({n: m.data}), RELIABLE,
                       private=False)
        self.create_timer(WRITE_PERIOD, self.write)

    def _add(self, kind: str, msg: Any) -> None:
        objects = from_marker_array(msg)
        if not msg.markers:
            raise InputError("an empty MarkerArray has no stamp, so it cannot be matched; send a "
                             "DELETE marker with the header of the frame")
        if objects.stamp_ns in self.scored:  # a bag that is played again
            return
        frame = self.waiting.setdefault(objects.stamp_ns, {})
        frame[kind] = objects
        if len(frame) == 1 + len(self.params.stages):
            del self.waiting[objects.stamp_ns]
            self.scored[objects.stamp_ns] = None
            if len(self.scored) > REMEMBERED:
                del self.scored[next(iter(self.scored))]
            self._score(frame)
        while len(self.waiting) > WAITING_FRAMES:
            self.waiting.pop(next(iter(self.waiting)))
            self.counts["incomplete"] += 1
            self.report(WARN, "frames without ground truth or detections of the same header.stamp")

    def _score(self, frame: dict[str, Any]) -> None:
        self.counts["frames"] += 1
        truth = to_truth(frame["truth"]).of_class(PEDESTRIAN)
        if len(truth) or not self.params.only_with_pedestrians:
            found = {s: to_detections(frame[s]) for s in self.params.stages}
            self.result.update(CandidateResult(truth, {s: d.boxes[d.class_ids == PEDESTRIAN]
                                                       for s, d in found.items()}, {}))
        self.counts.update(scored=self.result.frames, **{
            f"F1 of {s}": f"{score.table()['all']['f1']:.3f}"
            for s, score in self.result.scores.items()})
        self.report(OK, "scoring" if self.result.frames else "no frame with a Pedestrian yet")

    def write(self) -> None:
        if self.params.file:
            content = self.result.compute()
            content["lost_frames"] = self.counts["incomplete"] + len(self.waiting)
            write_text(self.params.file, json.dumps(content, indent=1))

    def close(self) -> None:
        self.write()

"""Inference of PointPillars on a normalized view: pillars, network, decoding and NMS."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from typing import NamedTuple

import numpy as np
from scipy.special import expit, logit

from lidar_perception.detectors.calibration import calibrate_scores
from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.detectors.devices import CPU
from lidar_perception.detectors.nms import apply_nms
from lidar_perception.detectors.normalized_view import (
    NormalizedView,
    crop_to_range,
    rotate_boxes_half_turn,
    rotate_half_turn,
)
from lidar_perception.detectors.params import NmsParams, ScoreParams
from lidar_perception.detectors.pointpillars.anchors import decode, make_anchors
from lidar_perception.detectors.pointpillars.config import HALF, RANGES, NetworkConfig
from lidar_perception.detectors.pointpillars.expert import NetworkInput, make_network_input
from lidar_perception.detectors.pointpillars.pillars import make_pillars
from lidar_perception.detectors.pointpillars.prediction import Network, Prediction
from lidar_perception.detectors.trained_network import TrainedNetwork
from lidar_perception.types import EMPTY_CLOUD, SENSOR_HEIGHT, Detections, InputError

OVERLAP_M = 1.0  # each pass also returns boxes whose centre is up to this distance behind the sensor
TIMED_STEPS = ("preprocess", "network", "postprocess")


class Boxes(NamedTuple):
    """Boxes of one pass before NMS.

    Attributes:
        boxes: (M, 7).
        logits: (M,) logits of the best class.
        labels: (M,) int, index of this class in `classes`.
    """

    boxes: np.ndarray
    logits: np.ndarray
    labels: np.ndarray


class PointPillarsProposer(TrainedNetwork):
    """A PointPillars network of any version that proposes boxes in a NormalizedView.

    The network usually runs once, over the range of its config. A network trained for `ahead`
    covers `around` in two passes over HALF; the second pass reads the cloud rotated by 180 degrees
    about z.

    Args:
        pass_config: config of each of two passes; None: one pass with the config of `header`.
    """

    network: Network

    def __init__(self, network: Network, header: Header, device: str = CPU, pass_config: NetworkConfig | None = None):
        super().__init__(network, header, device)
        self.pass_config = pass_config or self.config
        self.half_turns = (False,) if pass_config is None else (False, True)
        self.anchors = make_anchors(self.pass_config)

    def with_range(self, range: str) -> PointPillarsProposer:
        """Return a copy of this network with a different range, see NetworkDetector.with_range."""
        if range == "auto" or (range == "around") == (self.config.low[0] < 0):
            return self
        if self.network.has_fixed_range:
            raise InputError(f"an exported network has a fixed range; use the checkpoint for the range {range}")
        try:
            config = replace(self.config, **RANGES[range])
            pass_config = replace(self.config, **HALF) if range == "around" else None
        except ValueError as error:
            raise InputError(f"this network does not support the range {range}: {error}") from None
        other = PointPillarsProposer(self.network, replace(self.header, config=config), self.device, pass_config)
        other.placement = self.placement
        return other

    def propose(
        self,
        view: NormalizedView,
        ground: np.ndarray | None,
        cluster_ids: np.ndarray | None,
        scores: ScoreParams,
        nms: NmsParams,
        cpu_fallback: bool = True,
    ) -> DetectionResult:
        """Propose boxes for a view of M points, in the coordinates of the view.

        Args:
            ground: (M,) bool; required if the version removes the ground.
            cluster_ids: (M,) int, 0 or less for no cluster; required if the version uses clusters.
            scores: thresholds of the calibrated scores.

        Returns:
            Detections, which may include the ego vehicle, and the timings of TIMED_STEPS.
        """
        begin = self.get_time()
        inputs = self._make_inputs(view, ground, cluster_ids)
        problem = self._find_problem(view, inputs)
        if not inputs:
            return DetectionResult(
                Detections.none(), dict.fromkeys(TIMED_STEPS, 0.0), problem or self.placement.fallback
            )

        def compute() -> tuple[list[float], DetectionResult]:
            times, predictions = self._predict(inputs)
            result = self._decode(predictions, self.to_raw_scores(scores.get_all(self.classes)), nms)
            return [begin, *times, self.get_time()], result

        times, result = self.run(compute, cpu_fallback)
        timings = dict(zip(TIMED_STEPS, (np.diff(times) * 1e3).tolist()))
        return replace(result, timings=timings, problem=result.problem or problem or self.placement.fallback)

    def _make_inputs(
        self, view: NormalizedView, ground: np.ndarray | None, cluster_ids: np.ndarray | None
    ) -> dict[bool, NetworkInput]:
        """Return the input of each pass that has points; the key is True for the rotated pass."""
        if len(self.half_turns) == 1:
            inputs = {False: make_network_input(view.frame, self.config, ground, cluster_ids)}
        else:
            frame, inputs = view.frame, {}
            if self.config.remove_ground and ground is not None:  # the network reads obstacles only
                obstacles = np.flatnonzero(~ground)
                frame, ground = frame.take(obstacles), ground[obstacles]
                cluster_ids = None if cluster_ids is None else cluster_ids.take(obstacles)
            for half_turn in self.half_turns:
                indices, part = crop_to_range(
                    rotate_half_turn(frame) if half_turn else frame, self.pass_config.low, self.pass_config.high
                )
                part_ground, part_ids = (
                    column if column is None else column.take(indices) for column in (ground, cluster_ids)
                )
                inputs[half_turn] = make_network_input(part, self.pass_config, part_ground, part_ids)
        return {half_turn: network_input for half_turn, network_input in inputs.items() if len(network_input.points)}

    def _predict(self, inputs: dict[bool, NetworkInput]) -> tuple[list[float], dict[bool, Prediction]]:
        """Run the network; return its start and end time, and the prediction of each pass."""
        arguments = []
        for network_input in inputs.values():
            maps = None if network_input.cluster_map is None else network_input.cluster_map[None]
            arguments.append((make_pillars(network_input.points, self.pass_config), maps))
        begin = self.get_time()
        predictions = [self.network(*pass_arguments) for pass_arguments in arguments]
        return [begin, self.get_time()], dict(zip(inputs, predictions))

    def _decode(self, predictions: dict[bool, Prediction], min_scores: list[float], nms: NmsParams) -> DetectionResult:
        """Decode and merge the predictions of all passes."""
        pass_boxes = [
            self._select_boxes(half_turn, prediction, min_scores, nms.candidates)
            for half_turn, prediction in predictions.items()
        ]
        boxes, best_logits, labels = map(np.concatenate, zip(*pass_boxes))
        best_scores: dict[str, float] = {}
        problem: str | None = None
        logits = [prediction.logits for prediction in predictions.values() if len(prediction.logits)]
        if any(len(rows) > 1 and np.array_equal(rows[0], rows[-1]) and (rows == rows[0]).all() for rows in logits):
            boxes, best_logits, labels = boxes[:0], best_logits[:0], labels[:0]
            problem = "the network's scores are the same at all anchors; the weights are invalid, use other weights"
        elif len(boxes) == 0 and logits:
            class_scores = expit(np.concatenate(logits).max(axis=0))
            best_scores, problem = self.find_best_scores(class_scores.tolist())
        detections = apply_nms(boxes, expit(best_logits), labels, self.classes, nms)
        return DetectionResult(calibrate_scores(detections, self.header.calibration), problem=problem, best=best_scores)

    def _select_boxes(self, half_turn: bool, prediction: Prediction, min_scores: list[float], max_boxes: int) -> Boxes:
        """Return the boxes of one pass that reach their thresholds, in the coordinates of the view."""
        logits = prediction.logits
        thresholds = logit(min_scores).astype(np.float32)
        # One operation per class, because a reduction over three columns takes three times as long.
        rows = np.flatnonzero(reduce(np.logical_or, map(np.greater_equal, logits.T, thresholds)))
        labels = logits[rows].argmax(axis=1)
        best_logits = logits[rows, labels]
        indices = np.flatnonzero(best_logits >= thresholds[labels])
        if len(indices) > max_boxes:
            indices = indices[np.argpartition(-best_logits[indices], max_boxes)[:max_boxes]]
        rows, best_logits, labels = rows[indices], best_logits[indices], labels[indices]
        codes, directions = prediction.compute_boxes(rows)
        anchors = self.anchors[rows if prediction.anchors is None else prediction.anchors[rows]]
        boxes = Boxes(
            decode(codes, directions.argmax(axis=1), anchors, self.config.direction_offset), best_logits, labels
        )
        if len(self.half_turns) > 1:
            is_in_half = boxes.boxes[:, 0] >= -OVERLAP_M
            boxes = Boxes(*(column[is_in_half] for column in boxes))
        return boxes._replace(boxes=rotate_boxes_half_turn(boxes.boxes)) if half_turn else boxes

    def _find_problem(self, view: NormalizedView, inputs: dict[bool, NetworkInput]) -> str | None:
        """Return the reason why few or no objects can be detected, with a remedy, or None."""
        if len(view.source) == 0:
            return EMPTY_CLOUD
        if len(view) == 0:
            low, high = self.config.low, self.config.high
            return (
                f"no points in the network's range, x {low[0]:g} .. {high[0]:g}, y {low[1]:g} .. {high[1]:g}, "
                f"z {low[2]:g} .. {high[2]:g} m for a sensor at a height of {SENSOR_HEIGHT} m; check that x points "
                "forward and that ground.sensor_pose is correct"
            )
        intensity = view.frame.intensity
        if intensity is not None and (invalid_count := len(view) - np.count_nonzero(np.isfinite(intensity))):
            return (
                f"{invalid_count} of {len(view)} points are ignored because their intensity is NaN; use "
                "0 for unknown intensities"
            )
        if not inputs:
            return (
                "all points in the network's range are ground; set ground.sensor_pose to the sensor's actual height "
                "and tilt"
            )
        return view.find_intensity_problem()

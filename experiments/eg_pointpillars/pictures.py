"""Pictures of V0 and V4 on the same frames (Figure 20 of the paper)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.eg_pointpillars.models import COMPARED_VERSIONS, group_seeds
from experiments.framework.experiment import Picture, Section
from experiments.framework.precision import RELAXED_BEV, compare_records
from experiments.framework.trained_models import TrainedModel
from lidar_perception.data.frame import Frame
from lidar_perception.detectors.open import open_detector
from lidar_perception.rendering.picture import Boxes, RenderSettings, draw_frame
from lidar_perception.scoring.kitti.protocol import (
    COUNTED,
    METRICS,
    SCORED,
    ComparedFrame,
    classify_detections,
    classify_labels,
)
from lidar_perception.types import CLASSES, InputError

MIN_SHOWN_SCORE = 0.3
SIZE = (1280, 540)  # size of each half of a picture, in pixels
MAX_BETTER, MAX_WORSE = 2, 1  # numbers of pictures in which V4 makes fewer errors than V0, and more errors


def make_picture_sections(
    records: list[dict[str, Any]], frames: Sequence[Frame], models: Mapping[str, TrainedModel]
) -> list[Section]:
    """Make Figure 20 from the frames with the largest differences between the errors of V0 and V4."""
    groups = group_seeds(models)
    if any((version, 1.0) not in groups for version in COMPARED_VERSIONS):
        return []
    v0, v4 = (groups[version, 1.0][0] for version in COMPARED_VERSIONS)
    records = [record for record in records if "skipped" not in record]
    errors = {
        name: {
            record["frame"]: count_errors(frame)
            for record, frame in zip(
                records, compare_records([r["true"] for r in records], [r["found"][name] for r in records])
            )
        }
        for name in (v0, v4)
    }
    measured_frames = [frame for frame in frames if frame.name in errors[v0]]
    gain = np.array([errors[v0][frame.name] - errors[v4][frame.name] for frame in measured_frames])
    order = np.argsort(-gain, kind="stable")
    better, worse = order[gain[order] > 0], order[gain[order] < 0]
    picture_indices = [*better[:MAX_BETTER], *worse[::-1][:MAX_WORSE]] or [*order[:1]]
    pictures: list[Picture] = []
    for k in picture_indices:
        frame = measured_frames[k]
        pictures.append(
            Picture(
                f"figure_20_{len(pictures) + 1}",
                f"{frame.name}: {v0} (above, errors: {errors[v0][frame.name]}) and {v4} (below, errors: "
                f"{errors[v4][frame.name]})",
                np.concatenate([_draw(frame, models[name], name) for name in (v0, v4)], axis=0),
            )
        )
    text = (
        f"Boxes with a score of at least {MIN_SHOWN_SCORE:g}; labels are dashed. V4 makes fewer errors than V0 in "
        f"{len(better)} frames and more in {len(worse)}. Of the frames with the largest differences, up to "
        f"{MAX_BETTER} of the first kind and {MAX_WORSE} of the second are shown; the paper shows three of the first "
        "kind. An error is a miss or a false positive, in BEV at overlaps of 0.5 (Car) and 0.25."
    )
    return [Section("V0 and V4 on the same frames (Figure 20)", text, figures=tuple(pictures))]


def count_errors(frame: ComparedFrame) -> int:
    """Count moderate misses and false positives. Only boxes with a score of at least MIN_SHOWN_SCORE count."""
    overlaps = frame.overlaps[METRICS.index(RELAXED_BEV[0])]
    errors = 0
    for name in SCORED:
        matches = overlaps > RELAXED_BEV[1][name]
        is_detected = (
            (frame.detections.class_ids == CLASSES.index(name))
            & (frame.detections.scores >= MIN_SHOWN_SCORE)
            & (classify_detections(frame.detections, name, "moderate") == COUNTED)
        )
        is_counted_label = classify_labels(frame.labels, name, "moderate") == COUNTED
        is_label = frame.labels.class_ids == CLASSES.index(name)
        errors += int((is_counted_label & ~matches[is_detected].any(axis=0)).sum())
        errors += int((is_detected & ~matches[:, is_label].any(axis=1)).sum())
    return errors


def _draw(frame: Frame, model: TrainedModel, title: str) -> np.ndarray:
    """Draw a frame with the boxes of a network. Return pixels (height, width, 3) uint8."""
    scan, truth = frame.load(), frame.truth()
    try:
        detector = open_detector(str(model.weights), sensor_height=frame.sensor_height, min_score=MIN_SHOWN_SCORE)
        detections = detector(scan).detections
        boxes = Boxes(detections.boxes, detections.class_ids, [f"{score:.2f}" for score in detections.scores])
    except InputError:
        boxes = Boxes()
    labels = (
        np.zeros((0, 7))
        if truth is None
        else truth.boxes[np.isin(truth.class_ids, [CLASSES.index(name) for name in SCORED])]
    )
    settings = RenderSettings.of(scan, frame.sensor_height, True, size=SIZE)
    return draw_frame(settings, scan, boxes, labels, title)

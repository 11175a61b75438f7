"""Pictures of V0 and V4 on the same frames (Figure 20 of the paper)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.eg_pointpillars.models import STUDIED, group_seeds
from experiments.framework.experiment import Picture, Section
from experiments.framework.precision import RELAXED_BEV, compare_records
from experiments.framework.trained_models import TrainedModel
from lidar_perception.data.frame import Frame
from lidar_perception.detectors.open import open_detector
from lidar_perception.rendering.picture import Boxes, Stage, draw_frame
from lidar_perception.scoring.kitti.protocol import (
    COUNTED,
    METRICS,
    SCORED,
    ComparedFrame,
    classify_detections,
    classify_labels,
)
from lidar_perception.types import CLASSES, InputError

SHOWN_SCORE = 0.3
SIZE = (1280, 540)  # size of each half of the picture, in pixels
BETTER, WORSE = 2, 1  # number of frames to show in which V4 makes fewer errors, and more errors


def make_picture_sections(
    records: list[dict[str, Any]], frames: Sequence[Frame], models: Mapping[str, TrainedModel]
) -> list[Section]:
    """Return Figure 20: the frames in which the errors of V0 and V4 differ most, both ways."""
    groups = group_seeds(models)
    if any((version, 1.0) not in groups for version in STUDIED):
        return []
    first, last = (groups[version, 1.0][0] for version in STUDIED)
    measured = [record for record in records if "skipped" not in record]
    errors = {
        name: [
            count_errors(frame)
            for frame in compare_records([r["true"] for r in measured], [r["found"][name] for r in measured])
        ]
        for name in (first, last)
    }
    by_name = {record["frame"]: i for i, record in enumerate(measured)}
    indices = [i for i, frame in enumerate(frames) if frame.name in by_name]
    gain = np.array([errors[first][by_name[frames[i].name]] - errors[last][by_name[frames[i].name]] for i in indices])
    order = np.argsort(-gain, kind="stable")
    better, worse = order[gain[order] > 0], order[gain[order] < 0]
    chosen = [*better[:BETTER], *worse[::-1][:WORSE]] or [*order[:1]]
    pictures: list[Picture] = []
    for k in chosen:
        frame = frames[indices[k]]
        counts = [errors[name][by_name[frame.name]] for name in (first, last)]
        pictures.append(
            Picture(
                f"figure_20_{len(pictures) + 1}",
                f"{frame.name}: {first} (above, errors: {counts[0]}) and {last} (below, errors: {counts[1]})",
                np.concatenate([_draw(frame, models[name], name) for name in (first, last)], axis=0),
            )
        )
    text = (
        f"Boxes with a score of at least {SHOWN_SCORE:g}; labels are dashed. V4 has fewer errors than V0 in "
        f"{len(better)} frames and more in {len(worse)}. Up to {BETTER} frames of the first kind and {WORSE} of "
        "the second are shown, those with the largest difference; the paper shows three of the first kind. An "
        "error is a missed object or a wrong box, in BEV at the overlaps 0.5 (Car) and 0.25."
    )
    return [Section("V0 and V4 on the same frames (Figure 20)", text, figures=tuple(pictures))]


def count_errors(frame: ComparedFrame) -> int:
    """Count missed objects (moderate) and wrong boxes, with a score of at least SHOWN_SCORE."""
    overlaps = frame.overlaps[METRICS.index(RELAXED_BEV[0])]
    errors = 0
    for name in SCORED:
        hit = overlaps > RELAXED_BEV[1][name]
        own = frame.true.class_ids == CLASSES.index(name)
        found = (
            (frame.found.class_ids == CLASSES.index(name))
            & (frame.found.scores >= SHOWN_SCORE)
            & (classify_detections(frame.found, name, "moderate") == COUNTED)
        )
        wanted = classify_labels(frame.true, name, "moderate") == COUNTED
        errors += int((wanted & ~hit[found].any(axis=0)).sum())
        errors += int((found & ~hit[:, own].any(axis=1)).sum())
    return errors


def _draw(frame: Frame, model: TrainedModel, title: str) -> np.ndarray:
    """Draw a frame with the boxes of a network, (height, width, 3) uint8."""
    scan, truth = frame.load(), frame.truth()
    try:
        found = open_detector(str(model.weights), sensor_height=frame.sensor_height, min_score=SHOWN_SCORE)(
            scan
        ).detections
        boxes = Boxes(found.boxes, found.class_ids, [f"{score:.2f}" for score in found.scores])
    except InputError:
        boxes = Boxes()
    labels = (
        np.zeros((0, 7))
        if truth is None
        else truth.boxes[np.isin(truth.class_ids, [CLASSES.index(name) for name in SCORED])]
    )
    stage = Stage.of(scan, frame.sensor_height, True, size=SIZE)
    return draw_frame(stage, scan, boxes, labels, title)

"""Tracks that were recorded to a bag, against the labels beside them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.bag import Bag
from lidar_perception.scoring.tracking.pairs import tracked_labels
from lidar_perception.scoring.tracking.report import TrackingReport, observe
from lidar_perception.types import InputError
from lidar_perception.wire.messages import to_detections, to_truth
from lidar_perception.wire.topics import TRUTH
from msg_utils.markers import MarkedObjects, from_marker_array


def recorded_tracks(path: Path, topic: str, name: str, calibration: Calibration | None
                    ) -> tuple[int, dict[str, Any] | None, str | None]:
    """How many tracks of the class `name` there are on a topic of a bag; their scores as
    TrackingReport has them, by the labels on TRUTH, and why there are none, if so. Frames without
    an answer do not count."""
    with Bag(path) as bag:
        found: dict[str, dict[int, MarkedObjects]] = {topic: {}, TRUTH: {}}
        for where, _, msg in bag.messages(found.keys() & bag.topics.keys()):
            objects = from_marker_array(msg)
            found[where][objects.stamp_ns] = objects
    number = len({i for each in found[topic].values()
                  for i, label in zip(each.ids.tolist(), each.labels) if label == name})
    report = TrackingReport()
    stamps = sorted(found[topic].keys() & found[TRUTH].keys())
    try:
        for i, stamp in enumerate(stamps):
            tracks = found[topic][stamp]
            report.update(observe("bag", i, to_truth(found[TRUTH][stamp]), tracked_labels(
                np.asarray(tracks.ids), to_detections(tracks)), calibration))
    except InputError as error:
        return number, None, str(error)
    scores = report.compute()["classes"][name]
    return number, scores, None if scores else f"there is no {name}, neither labelled nor tracked"

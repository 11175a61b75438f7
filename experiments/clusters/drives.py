"""nuScenes scores with velocities from the tracker (paper C, Table 7)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np

from experiments.clusters import paper
from experiments.clusters.detection import detect_with_all
from experiments.clusters.networks import COMPARED, OURS, get_compared_sources, name_model
from experiments.framework.experiment import Row, Section, Table
from experiments.framework.statistics import estimate, make_cells
from experiments.framework.trained_models import TrainedModel
from lidar_perception.data.frame import Frame
from lidar_perception.data.nuscenes.boxes import NAMES, GlobalBoxes, to_global_boxes
from lidar_perception.data.nuscenes.folder import KeyFrame
from lidar_perception.data.nuscenes.labels import NuscenesLabels
from lidar_perception.data.nuscenes.results import NAME_BY_CLASS, to_results
from lidar_perception.robot.poses import transform_boxes
from lidar_perception.scoring.intervals import draw_samples
from lidar_perception.scoring.nuscenes.protocol import ERRORS, score_class, summarize
from lidar_perception.scoring.nuscenes.report import select_boxes
from lidar_perception.simulation.drive import SimulatedScan, simulate_drive
from lidar_perception.tracking.state import Tracks
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.types import CLASSES

FIRST_DRIVE = 41_000_000  # seed of the first drive, far from the seeds used for training
SIMULATED_DRIVES, SCANS = 2, 12
MAX_TRACK_DISTANCE_M = 1.0  # maximum distance from a detection to the track that gives it a velocity
REPLICATES = 100
SCORES = ("map", *ERRORS, "nds")
TITLES = ("mAP [%]", "ATE [m]", "ASE", "AOE [rad]", "AVE [m/s]", "AAE", "NDS [%]")
SCALE = np.array([100.0, 1, 1, 1, 1, 1, 100])
DIGITS = (1, 3, 3, 3, 3, 3, 1)
OUR_CLASSES = tuple(NAME_BY_CLASS.values())


def measure_drive(
    frames: Sequence[Frame], number: int, models: Mapping[str, TrainedModel]
) -> list[dict[str, Any]] | None:
    """Detect and track the objects of the drive that starts at frame `number`.

    Drives are the scenes of nuScenes. Other recordings have no nuScenes labels, so their first
    SIMULATED_DRIVES frames stand for simulated drives.

    Returns:
        One dict per key frame with `truth` and `found` (network -> boxes with velocities, see
        to_columns()); None if no drive starts at this frame.
    """
    sources, drive = get_compared_sources(models), list_drive(frames, number)
    if not drive:
        return None
    trackers, rows = {name: Tracker() for name in sources}, []
    for frame in drive:
        pose, truth, detections = frame.native.pose, GlobalBoxes.none(), {}
        for name, (boxes, _) in detect_with_all(frame.load(), sources, frame.sensor_height, "around").items():
            tracks = trackers[name](boxes, frame.stamp_ns, pose)
            result = select_boxes(frame, add_velocities(to_results(boxes, frame), tracks, pose))
            if result.truth is None or result.detections is None:
                return None
            truth, detections[name] = result.truth, to_columns(result.detections)
        rows.append({"truth": to_columns(truth), "found": detections})
    return rows


def list_drive(frames: Sequence[Frame], number: int) -> Sequence[Frame]:
    """Return the frames of the drive that starts at frame `number`, see measure_drive()."""
    frame = frames[number]
    if not isinstance(frame.native, KeyFrame):
        return simulate_key_frames(FIRST_DRIVE + number) if number < SIMULATED_DRIVES else ()
    if number and frames[number - 1].sequence == frame.sequence:
        return ()
    end = number
    while end < len(frames) and frames[end].sequence == frame.sequence:
        end += 1
    return frames[number:end]


def simulate_key_frames(seed: int) -> list[Frame]:
    """Return the frames of a simulated drive, labelled all around as in nuScenes."""
    scans = [*simulate_drive(seed, SCANS)]
    return [
        Frame.of(
            f"drive {seed}/{i}",
            scan.frame,
            pose=scan.pose.copy,
            native=KeyFrame(f"{seed}/{i}", scan.pose, scan.pose[:3, 3], partial(label_scan, scans, i)),
        )
        for i, scan in enumerate(scans)
    ]


def label_scan(scans: Sequence[SimulatedScan], number: int) -> NuscenesLabels:
    """Return the labels of a scan of a drive, with velocities from the scans before and after it."""
    scan, previous, following = scans[number], scans[max(number - 1, 0)], scans[min(number + 1, len(scans) - 1)]
    positions = _find_positions(previous), _find_positions(following)
    seconds = max(1e-9 * (following.frame.stamp_ns - previous.frame.stamp_ns), 1e-9)
    ids = [extra["track_id"] for extra in scan.truth.extras]
    unknown = np.full(2, np.nan)
    velocities = np.array(
        [(positions[1].get(i, unknown) - positions[0].get(i, unknown)) / seconds for i in ids]
    ).reshape(-1, 2)
    names = [NAME_BY_CLASS.get(CLASSES[i], "") for i in scan.truth.class_ids]
    points = [extra["num_points"] for extra in scan.truth.extras]
    boxes = GlobalBoxes.of(
        *to_global_boxes(scan.truth.boxes, scan.pose),
        [NAMES.index(name) if name else -1 for name in names],
        velocities=velocities,
        points=points,
    )
    return NuscenesLabels(boxes, np.zeros(len(boxes), int), ("simulated",), np.array(points, int), np.array(ids, int))


def _find_positions(scan: SimulatedScan) -> dict[int, np.ndarray]:
    """Return the global position (2,) of each object by its track id."""
    centres = to_global_boxes(scan.truth.boxes, scan.pose)[0][:, :2]
    return {extra["track_id"]: centre for extra, centre in zip(scan.truth.extras, centres)}


def add_velocities(boxes: GlobalBoxes, tracks: Tracks, pose: np.ndarray) -> GlobalBoxes:
    """Give each box the velocity of the nearest track.

    A box without a track within MAX_TRACK_DISTANCE_M gets the velocity 0.

    Args:
        boxes: K boxes in the global frame.
        tracks: Tracks in the sensor's frame.
        pose: (4, 4) pose of the sensor in the global frame.
    """
    velocities = np.zeros((len(boxes), 2))
    if len(tracks) and len(boxes):
        centres = transform_boxes(tracks.detections.boxes, pose)[:, :2]
        distances = np.linalg.norm(boxes.centres[:, None, :2] - centres, axis=2)
        nearest = distances.argmin(axis=1)
        has_track = distances[np.arange(len(boxes)), nearest] <= MAX_TRACK_DISTANCE_M
        velocities[has_track] = (tracks.velocities @ pose[:2, :2].T)[nearest[has_track]]
    return replace(boxes, velocities=velocities)


def to_columns(boxes: GlobalBoxes) -> dict[str, list]:
    """Convert boxes to a JSON-serialisable dict, with None for NaN."""
    columns = {f.name: np.round(getattr(boxes, f.name), 4) for f in fields(GlobalBoxes)}
    return {name: np.where(np.isnan(values), np.array(None), values).tolist() for name, values in columns.items()}


def from_columns(columns: Mapping[str, list]) -> GlobalBoxes:
    """Convert the result of to_columns() back to boxes."""
    if not columns["centres"]:
        return GlobalBoxes.none()
    return GlobalBoxes.of(**{name: np.array(values, float) for name, values in columns.items()})


def compute_scores(truth: Sequence[GlobalBoxes], detections: Sequence[GlobalBoxes]) -> np.ndarray:
    """Compute SCORES (7,) from the boxes of each frame, over our classes; NaN if there are no labels."""
    truth_frames, detection_frames = (
        np.repeat(np.arange(len(frames)), [len(boxes) for boxes in frames]) for frames in (truth, detections)
    )
    all_truth, all_detections = (GlobalBoxes.concatenate([*frames]) for frames in (truth, detections))
    if len(all_truth) == 0:
        return np.full(len(SCORES), np.nan)
    summary = summarize(
        {name: score_class(name, all_truth, truth_frames, all_detections, detection_frames) for name in OUR_CLASSES}
    )
    return SCALE * [summary[name] for name in SCORES]


def make_drive_section(records: list[dict[str, Any]], data: str) -> Section:
    """Make Table 7 from the drives in the records."""
    key_frames = [row for record in records for row in record.get("drive") or ()]
    truth = [from_columns(row["truth"]) for row in key_frames]
    samples = [np.arange(len(truth)), *draw_samples([np.array([i]) for i in range(len(truth))], REPLICATES)]
    rows: list[Row] = []
    for network in (n for n in COMPARED if all(name_model(n, 0) in row["found"] for row in key_frames)):
        detections = [from_columns(row["found"][name_model(network, 0)]) for row in key_frames]
        without_velocities = [replace(b, velocities=np.full((len(b), 2), np.nan)) for b in detections]
        for title, boxes in (("without velocities", without_velocities), ("velocities of the tracker", detections)):
            draws = np.stack(
                [compute_scores([truth[i] for i in sample], [boxes[i] for i in sample]) for sample in samples]
            )
            has_published = network == OURS and boxes is detections
            published_values = [paper.TABLE_7.get(score) for score in SCORES] if has_published else ()
            rows.append((network, title, *make_cells(estimate(draws), published_values, DIGITS)))
    source = "nuScenes" if data == "nuScenes" else f"{SIMULATED_DRIVES} simulated drives"
    return Section(
        "Scores of nuScenes (Table 7)",
        f"{len(truth)} key frames of {source}. Means over "
        "car, pedestrian and bicycle (our Cyclist). Without velocities AVE is 1. AAE is always 1, "
        "because there are no attributes. So NDS is at most 90 with velocities and at most "
        "80 without. The paper does not name its classes and split.",
        (Table("table_7", "Table 7: scores of nuScenes", ("network", "", *TITLES), tuple(rows)),),
    )

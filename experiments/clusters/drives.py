"""Scores of nuScenes with velocities from the tracker (paper C, Table 7)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np

from experiments.clusters import paper
from experiments.clusters.detection import detect_with_all
from experiments.clusters.networks import COMPARED, OURS, list_compared, name_model
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

FIRST_DRIVE = 41_000_000  # first seed; no training uses seeds near it
SIMULATED_DRIVES, SCANS = 2, 12
MAX_TRACK_DISTANCE_M = 1.0  # maximum distance from a detection to the track that gives it a velocity
REPLICATES = 100
SCORES = ("map", *ERRORS, "nds")
TITLES = ("mAP [%]", "ATE [m]", "ASE", "AOE [rad]", "AVE [m/s]", "AAE", "NDS [%]")
SCALE = np.array([100.0, 1, 1, 1, 1, 1, 100])
DIGITS = (1, 3, 3, 3, 3, 3, 1)
NAMES_OF_OURS = tuple(NAME_BY_CLASS.values())


def measure_drive(
    frames: Sequence[Frame], number: int, models: Mapping[str, TrainedModel]
) -> list[dict[str, Any]] | None:
    """Detect and track the objects of the drive that frame `number` begins.

    Drives are the scenes of nuScenes. For other recordings, which have no such labels, the first
    SIMULATED_DRIVES frames stand for simulated drives.

    Returns:
        For each key frame truth, and found: network -> boxes with velocities, as of to_columns();
        None for a frame that begins no drive.
    """
    compared, drive = list_compared(models), list_drive(frames, number)
    if not drive:
        return None
    trackers, rows = {name: Tracker() for name in compared}, []
    for frame in drive:
        pose, truth, found = frame.native.pose, GlobalBoxes.none(), {}
        for name, (boxes, _) in detect_with_all(frame.load(), compared, frame.sensor_height, "around").items():
            tracks = trackers[name](boxes, frame.stamp_ns, pose)
            result = select_boxes(frame, add_velocities(to_results(boxes, frame), tracks, pose))
            if result.truth is None or result.counted is None:
                return None
            truth, found[name] = result.truth, to_columns(result.counted)
        rows.append({"truth": to_columns(truth), "found": found})
    return rows


def list_drive(frames: Sequence[Frame], number: int) -> Sequence[Frame]:
    """Return the frames of the drive that frame `number` begins, see measure_drive()."""
    frame = frames[number]
    if not isinstance(frame.native, KeyFrame):
        return simulate_key_frames(FIRST_DRIVE + number) if number < SIMULATED_DRIVES else ()
    if number and frames[number - 1].sequence == frame.sequence:
        return ()
    last = number
    while last < len(frames) and frames[last].sequence == frame.sequence:
        last += 1
    return frames[number:last]


def simulate_key_frames(seed: int) -> list[Frame]:
    """Return the frames of a simulated drive, with labels all around as of nuScenes."""
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
    """Return the labels of a scan of a drive, with velocities from the scans around it."""
    scan = scans[number]
    places = [_find_places(scans[k]) for k in (max(number - 1, 0), min(number + 1, len(scans) - 1))]
    before, after = (scans[k].frame.stamp_ns for k in (max(number - 1, 0), min(number + 1, len(scans) - 1)))
    ids = [extra["track_id"] for extra in scan.truth.extras]
    unknown = np.full(2, np.nan)
    velocities = np.array(
        [(places[1].get(i, unknown) - places[0].get(i, unknown)) / max(1e-9 * (after - before), 1e-9) for i in ids]
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


def _find_places(scan: SimulatedScan) -> dict[int, np.ndarray]:
    """Return the global position (2,) of each object by its track id."""
    centres = to_global_boxes(scan.truth.boxes, scan.pose)[0][:, :2]
    return {extra["track_id"]: centre for extra, centre in zip(scan.truth.extras, centres)}


def add_velocities(boxes: GlobalBoxes, tracks: Tracks, pose: np.ndarray) -> GlobalBoxes:
    """Return global boxes (K) with the velocity of the nearest track.

    A box without a track within MAX_TRACK_DISTANCE_M stands still.
    """
    velocities = np.zeros((len(boxes), 2))
    if len(tracks) and len(boxes):
        centres = transform_boxes(tracks.detections.boxes, pose)[:, :2]
        apart = np.linalg.norm(boxes.centres[:, None, :2] - centres, axis=2)
        nearest = apart.argmin(axis=1)
        near = apart[np.arange(len(boxes)), nearest] <= MAX_TRACK_DISTANCE_M
        velocities[near] = (tracks.velocities @ pose[:2, :2].T)[nearest[near]]
    return replace(boxes, velocities=velocities)


def to_columns(boxes: GlobalBoxes) -> dict[str, list]:
    """Return boxes as a dict that JSON can hold, with None for NaN."""
    columns = {f.name: np.round(getattr(boxes, f.name), 4) for f in fields(GlobalBoxes)}
    return {name: np.where(np.isnan(values), np.array(None), values).tolist() for name, values in columns.items()}


def from_columns(columns: Mapping[str, list]) -> GlobalBoxes:
    """Return the boxes of to_columns()."""
    if not columns["centres"]:
        return GlobalBoxes.none()
    return GlobalBoxes.of(**{name: np.array(values, float) for name, values in columns.items()})


def compute_scores(truth: Sequence[GlobalBoxes], found: Sequence[GlobalBoxes]) -> np.ndarray:
    """Return SCORES (7,) of frames, over the classes that the networks know; NaN without labels."""
    true_frames, found_frames = (
        np.repeat(np.arange(len(parts)), [len(part) for part in parts]) for parts in (truth, found)
    )
    all_true, all_found = (GlobalBoxes.concatenate([*parts]) for parts in (truth, found))
    if len(all_true) == 0:
        return np.full(len(SCORES), np.nan)
    summary = summarize(
        {name: score_class(name, all_true, true_frames, all_found, found_frames) for name in NAMES_OF_OURS}
    )
    return SCALE * [summary[name] for name in SCORES]


def make_drive_section(records: list[dict[str, Any]], data: str) -> Section:
    """Return Table 7 of the drives in the records."""
    key_frames = [row for record in records for row in record.get("drive") or ()]
    truth = [from_columns(row["truth"]) for row in key_frames]
    samples = [np.arange(len(truth)), *draw_samples([np.array([i]) for i in range(len(truth))], REPLICATES)]
    rows: list[Row] = []
    for network in (n for n in COMPARED if all(name_model(n, 0) in row["found"] for row in key_frames)):
        found = [from_columns(row["found"][name_model(network, 0)]) for row in key_frames]
        unknown = [replace(b, velocities=np.full((len(b), 2), np.nan)) for b in found]
        for title, boxes in (("without velocities", unknown), ("velocities of the tracker", found)):
            draws = np.stack(
                [compute_scores([truth[i] for i in sample], [boxes[i] for i in sample]) for sample in samples]
            )
            known = [paper.TABLE_7.get(score) for score in SCORES] if (network == OURS and boxes is found) else ()
            rows.append((network, title, *make_cells(estimate(draws), known, DIGITS)))
    where = "nuScenes" if data == "nuScenes" else f"{SIMULATED_DRIVES} simulated drives"
    return Section(
        "Scores of nuScenes (Table 7)",
        f"{len(truth)} key frames of {where}. Means of "
        "car, pedestrian and bicycle (our Cyclist). Without velocities AVE is 1, and so "
        "is AAE, as there are no attributes: NDS is at most 90 with velocities, at most "
        "80 without. The paper does not name its classes and split.",
        (Table("table_7", "Table 7: scores of nuScenes", ("network", "", *TITLES), tuple(rows)),),
    )

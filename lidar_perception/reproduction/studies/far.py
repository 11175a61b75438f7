"""Question 5: far pedestrians have few points. Does it help to add the scans before, moved by the
odometry, or to average the confidence over them, and can moving people be told from standing
things?"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import expit, logit

from lidar_perception.candidates.accumulation import accumulate, aligned, velocities
from lidar_perception.candidates.boxes import snap_to_ground
from lidar_perception.candidates.configurations import BEST
from lidar_perception.candidates.segmented import Segmented
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.clustering.shapes import oriented_boxes
from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti.folder import PERIOD_NS
from lidar_perception.ground.params import mounted
from lidar_perception.ground.segment import segment_ground
from lidar_perception.ground.threshold import fit_plane
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.reproduction.experiment import Cell, Experiment, Section, Table
from lidar_perception.reproduction.labelled import Labelled, load_labelled, nearest_seed
from lidar_perception.reproduction.variants import Found, found_with, score, sections, seed_of
from lidar_perception.scoring.centres.matching import match_centres
from lidar_perception.tracking.ego import Odometry
from lidar_perception.types import PEDESTRIAN, InputError, LidarFrame

SCANS = (2, 3, 5)
FROM = 20.0         # metres; nearer, one scan has points enough and motion would smear
NEAR_AGAIN = 1.0    # metres, between a candidate and itself a scan earlier, without its own motion
ADDED = tuple(f"{n} scans added" for n in SCANS)
ALIGNED = f"{SCANS[-1]} scans added, moving ones aligned"
AUTOMATIC = with_values(BEST, {"seed.source": "automatic"})
PERSISTENT = {f"confidence over {SCANS[-1]} scans": BEST,
              f"automatic seed, confidence over {SCANS[-1]} scans": AUTOMATIC}
NAMES = ("one scan", *ADDED, ALIGNED, "automatic seed, one scan", *PERSISTENT)
TRULY_MOVES = 0.5   # m/s
LEAST = 1e-3        # of a probability, so that its odds are finite


def measure(frames: Sequence[Frame], number: int) -> dict[str, Any]:
    """The record of one frame: variants as in variants.py; motion: [moving that are said to move,
    moving, standing that are said to stand, standing] of the pedestrians found with 5 scans."""
    labelled = load_labelled(frames[number])
    before = _scans_before(frames, number, SCANS[-1] - 1)
    scans = [f.load().xyz for f in before] + [labelled.frame.xyz]
    ages = np.array([frames[number].stamp_ns - f.stamp_ns for f in before] + [0]) / 1e9
    poses = np.array([*map(Odometry(), scans)])
    ground = mounted(BEST, labelled.height).ground
    obstacles = [xyz[~segment_ground(LidarFrame(xyz), ground)] for xyz in scans]
    single = labelled.segmented(BEST)
    seed = functools.partial(nearest_seed, single, labelled)
    found = {NAMES[0]: found_with(single, seed, BEST)}
    earlier = [labelled.segmented(BEST, f.load()) for f in before]
    for name, params in PERSISTENT.items():
        own = functools.partial(seed_of, single, labelled, params)
        now = found_with(single, own, params)
        if params is AUTOMATIC:
            found["automatic seed, one scan"] = now
        found[name] = persistent(now, [found_with(s, own, params) for s in earlier], poses)
    motion = [0, 0, 0, 0]
    for many, name in zip(SCANS, ADDED):
        points = accumulate(obstacles[-many:], poses[-many:], ages[-many:], FROM)
        # So many more points stand for the same surface.
        params = with_values(BEST, {"resolution.azimuth_step":
                                    BEST.resolution.azimuth_step / many})
        merged = _segmented(points.xyz, labelled, single)
        found[name] = _joined(found[NAMES[0]], found_with(merged, seed, params))
        if many == SCANS[-1]:
            inside = labelled.camera.in_view(points.xyz)
            kept = type(points)(points.xyz[inside], points.age[inside])
            speed = velocities(kept, merged.cluster_ids)
            moved = aligned(kept, merged.cluster_ids, speed)
            sharp = _with_boxes(moved, merged.cluster_ids, single)
            found[ALIGNED] = _joined(found[NAMES[0]], found_with(sharp, seed, params))
            motion = _told_apart(sharp.boxes, speed, labelled, before, poses)
    truth = labelled.pedestrians
    return {"frame": frames[number].name, "motion": motion,
            "variants": {name: score(one, truth) for name, one in found.items()}}


def persistent(now: Found, earlier: list[Found], poses: np.ndarray) -> Found:
    """The candidates with the mean of their log-odds over scans: of each scan the nearest
    candidate, moved by the poses (S, 4, 4), the newest last; where none is near, nothing speaks
    against it that it does not say itself."""
    odds = [logit(np.clip(now.scores, LEAST, 1 - LEAST))]
    for found, pose in zip(earlier, np.linalg.inv(poses[-1]) @ poses[:-1]):
        moved = found.boxes[:, :3] @ pose[:3, :3].T + pose[:3, 3]
        far = np.linalg.norm(now.boxes[:, None, :2] - moved[None, :, :2], axis=2)
        if far.size == 0:
            continue
        nearest = far.argmin(axis=1)
        then = logit(np.clip(found.scores[nearest], LEAST, 1 - LEAST))
        odds.append(np.where(far.min(axis=1) <= NEAR_AGAIN, then, odds[0]))
    return now._replace(scores=expit(np.mean(odds, axis=0)))


def _scans_before(frames: Sequence[Frame], number: int, count: int) -> Sequence[Frame]:
    """The scans before this one in the same recording, the oldest first."""
    sequence = frames[number].name.rpartition("/")[0]
    if not sequence:
        raise InputError("a scan of KITTI's object layout has none before it; give a tracking or "
                         "raw folder")
    steps = range(max(number - count, 0), number)
    found = [frames[i] for i in steps if frames[i].name.rpartition("/")[0] == sequence
             and frames[number].stamp_ns - frames[i].stamp_ns < 1.5 * PERIOD_NS * (number - i)]
    if len(found) < count:
        raise InputError(f"has fewer than {count} scans before it")
    return found


def _segmented(xyz: np.ndarray, labelled: Labelled, single: Segmented) -> Segmented:
    """The clusters of accumulated obstacles in the camera's view, on the newest scan's ground."""
    xyz = xyz[labelled.camera.in_view(xyz)]
    ids = cluster_obstacles(xyz, np.zeros(len(xyz), bool), BEST.clustering)
    return _with_boxes(xyz, ids, single)


def _with_boxes(xyz: np.ndarray, ids: np.ndarray, single: Segmented) -> Segmented:
    plane = fit_plane(single.xyz.compress(single.ground, axis=0))
    boxes = snap_to_ground(oriented_boxes(xyz, ids, BEST.boxes.shape), plane)
    return Segmented(np.arange(len(xyz)), xyz, np.zeros(len(xyz), bool), ids, boxes)


def _told_apart(boxes: np.ndarray, speed: np.ndarray, labelled: Labelled,
                before: Sequence[Frame], poses: np.ndarray) -> list[int]:
    """Counts of the far pedestrians that have a cluster, see measure()."""
    first = before[0].truth()
    assert first is not None  # of labelled frames
    tracks = {e["track_id"]: box for box, e in zip(first.boxes, first.extras) if "track_id" in e}
    to_newest = np.linalg.inv(poses[-1]) @ poses[0]
    counts = [0, 0, 0, 0]
    people = np.flatnonzero(labelled.truth.class_ids == PEDESTRIAN)
    rows, columns = match_centres(boxes, labelled.truth.boxes[people])
    for k, j in zip(rows, columns):
        own = labelled.truth.boxes[people[j]]
        then = tracks.get(labelled.truth.extras[people[j]].get("track_id"))
        if then is None or np.hypot(*own[:2]) < FROM:
            continue
        came = to_newest[:3, :3] @ then[:3] + to_newest[:3, 3]
        moves = np.hypot(*(own[:2] - came[:2])) / (len(before) * PERIOD_NS / 1e9) > TRULY_MOVES
        said = speed[k].any()
        counts[0 if moves else 2] += int(said == moves)
        counts[1 if moves else 3] += 1
    return counts


def _joined(near: Found, far: Found) -> Found:
    """What the first found nearer than FROM, and the second beyond."""
    parts = [(near, np.hypot(*near.boxes[:, :2].T) < FROM),
             (far, np.hypot(*far.boxes[:, :2].T) >= FROM)]
    return Found(np.concatenate([f.boxes[kept] for f, kept in parts]),
                 np.concatenate([f.scores[kept] for f, kept in parts]), near.threshold)


def report(records: list[dict[str, Any]]) -> list[Section]:
    """The variants side by side, and how well moving people are told from standing ones."""
    made = sections("Far range", NAMES, records)
    counts = np.sum([r["motion"] for r in records if "skipped" not in r] or [[0] * 4], axis=0)
    rows = tuple((name, Cell(100 * right / all_ if all_ else None), str(int(right)), str(int(all_)))
                 for name, right, all_ in (("moving", *counts[:2]), ("standing", *counts[2:])))
    return [*made, Section(
        "Moving and standing", f"Pedestrians beyond {FROM:g} m that have a cluster; one moves if "
        f"its track is faster than {TRULY_MOVES:g} m/s.",
        (Table("motion", "Told apart", ("pedestrians", "right [%]", "right", "all"), rows),))]


STUDY = Experiment("far", "Far range", "Do scans before the newest help far away, and is what "
                   "moves told from what stands?", measure, report, {"best": flatten(BEST)})

"""The tracker: ids, velocities, evidence and invalid input."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from tracking_samples import (
    CAR,
    CYCLIST,
    START,
    TENTH,
    make_car,
    make_crowd_detections,
    make_detections,
    make_flat_pose,
    make_person,
)

from lidar_perception.geometry import bev_iou, wrap_angle
from lidar_perception.param_fields import with_values
from lidar_perception.robot.placement import make_tilted_pose
from lidar_perception.robot.poses import transform_boxes
from lidar_perception.tracking.association import assign, find_pairs
from lidar_perception.tracking.ego import Ego, advance_ego, is_valid_pose
from lidar_perception.tracking.existence import discount_observations
from lidar_perception.tracking.params import AssociationParams, TrackingParams
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.types import PEDESTRIAN, Detections


def track(frames, poses=None, tracker=None, stamps=None):
    """Return the Tracks of every frame, at 10 Hz unless stamps are given."""
    tracker = tracker or Tracker()
    return [
        tracker(found, START + i * TENTH if stamps is None else stamps[i], None if poses is None else poses[i])
        for i, found in enumerate(frames)
    ]


def test_ids_are_stable_and_velocities_correct():
    tracks = track(make_crowd_detections())
    assert {t.ids.tolist() == [1, 2, 3, 4, 5, 6] for t in tracks} == {True}
    last = tracks[-1]
    truth = np.array([[8, 0], [-5, 0], [4, 0], [1, 0.5], [0, 0], [-1, 0]])
    off = last.velocities - truth
    assert np.abs(off).max() < 0.5
    inside = np.einsum("ni,nij,nj->n", off, np.linalg.inv(last.covariances[:, 2:4, 2:4]), off)
    assert (inside < 16).all()  # the covariances are not overconfident
    assert (np.linalg.eigvalsh(last.covariances) > -1e-12).all()
    assert (last.moving[[0, 1, 2]] > 0.99).all() and last.moving[4] < 0.3


def test_heading_of_pedestrians_is_known_only_while_they_walk():
    """Detectors do not measure the heading of people, so it follows from their motion over ground."""
    rng = np.random.default_rng(5)
    frames = []
    for i in range(30):
        boxes = np.array([make_person(5 + 0.1 * i, 0.1 * i), make_person(10, -4), make_car(20, 8)])
        boxes[:2, 6] = rng.uniform(-np.pi, np.pi, 2)
        frames.append(Detections.of(boxes, [PEDESTRIAN, PEDESTRIAN, CAR], 0.9))
    last = track(frames, [np.eye(4)] * 30)[-1]
    walking, standing, parked = last.covariances[:, 4, 4]
    assert abs(wrap_angle(last.detections.boxes[0, 6] - np.pi / 4)) < 0.2 and walking < 0.3
    assert standing == pytest.approx(np.pi**2 / 3) and not last.covariances[1, 4, [0, 1, 2, 3, 5]].any()
    assert parked < 0.1
    without_poses = track(frames)[-1].covariances[:, 4, 4]
    assert without_poses[:2] == pytest.approx(np.pi**2 / 3) and without_poses[2] < 0.1


@pytest.mark.parametrize("rate", [20, 10, 5, 2])
def test_fast_car_is_one_track_at_any_rate(rate):
    frames = [make_detections(make_car(-60 + 28.0 * i / rate)) for i in range(20)]
    *_, last = track(frames, [np.eye(4)] * 20, stamps=[START + i * 10**9 // rate for i in range(20)])
    assert last.ids.tolist() == [1]
    np.testing.assert_allclose(last.velocities, [[28, 0]], atol=0.5)


def test_tracker_is_deterministic_and_keeps_its_input():
    frames = list(make_crowd_detections(3))
    before = [f.boxes.copy() for f in frames]
    first, second = track(frames), track(frames)
    for a, b in zip(first, second):
        for name in ("ids", "velocities", "covariances", "moving"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        np.testing.assert_array_equal(a.detections.boxes, b.detections.boxes)
    for frame, boxes in zip(frames, before):
        np.testing.assert_array_equal(frame.boxes, boxes)


@pytest.mark.parametrize("roll", [0.0, np.pi])
def test_moving_sensor_gives_same_tracks_as_static_one(roll):
    frames = list(make_crowd_detections(1))
    poses = [make_flat_pose(0.9 * i, 0.1 * i, 0.04 * i) @ make_tilted_pose(roll, 0.0) for i in range(len(frames))]
    transformed_boxes = [
        Detections.of(transform_boxes(f.boxes, np.linalg.inv(p)), f.class_ids, f.scores) for f, p in zip(frames, poses)
    ]
    standing = track(frames, [np.eye(4)] * len(frames))
    for still, seen, p in zip(standing, track(transformed_boxes, poses), poses):
        assert seen.ids.tolist() == still.ids.tolist()
        back = transform_boxes(seen.detections.boxes, p)
        np.testing.assert_allclose(back[:, :6], still.detections.boxes[:, :6], atol=1e-3)
        assert np.abs(wrap_angle(back[:, 6] - still.detections.boxes[:, 6])).max() < 1e-3
        np.testing.assert_allclose(seen.velocities @ p[:2, :2].T, still.velocities, atol=1e-3)
        side = np.linalg.det(p[:2, :2])
        np.testing.assert_allclose(side * seen.turn_rates, still.turn_rates, atol=1e-3)
        np.testing.assert_allclose(
            p[:2, :2] @ seen.covariances[:, 2:4, 2:4] @ p[:2, :2].T, still.covariances[:, 2:4, 2:4], atol=1e-3
        )
        np.testing.assert_allclose(seen.moving, still.moving, atol=1e-3)


def test_velocities_are_relative_without_poses():
    frames = [make_detections(make_car(30 - 0.8 * i)) for i in range(15)]
    last_tracks = track(frames)[-1]
    assert last_tracks.velocities[0] == pytest.approx([-8, 0], abs=0.3) and last_tracks.moving[0] > 0.99
    known = track(frames, [make_flat_pose(0.8 * i) for i in range(15)])[-1]
    assert known.velocities[0] == pytest.approx([0, 0], abs=0.2) and known.moving[0] < 0.4


def test_turn_rate_of_car_on_circle_is_correct():
    angle = np.arange(40) * 0.04  # 0.4 rad/s, 4 m/s
    tracks = track([make_detections(make_car(10 * np.sin(a), 10 - 10 * np.cos(a), a)) for a in angle])
    last = tracks[-1]
    assert last.ids.tolist() == [1] and last.turn_rates[0] == pytest.approx(0.4, abs=0.08)
    assert wrap_angle(last.detections.boxes[0, 6] - angle[-1]) == pytest.approx(0, abs=0.1)
    assert np.hypot(*last.velocities[0]) == pytest.approx(4, abs=0.4)


def test_tracker_keeps_id_and_position_over_missed_frames():
    frames = [make_detections(make_car(10 + i)) if i not in (8, 9) else Detections.none() for i in range(14)]
    tracks = track(frames)
    assert {t.ids.tolist()[0] for t in tracks if len(t)} == {1}
    assert tracks[8].ids.tolist() == [1] and not tracks[8].seen[0]
    assert tracks[8].detections.boxes[0, 0] == pytest.approx(18, abs=0.5)
    assert tracks[12].detections.boxes[0, 0] == pytest.approx(22, abs=0.3)


def test_track_ends_when_object_is_gone():
    tracker = Tracker()
    track([make_detections(make_car(10))] * 5 + [Detections.none()] * 60, tracker=tracker)
    assert (tracker.alive_count, tracker.started_count, tracker.ended_count) == (0, 1, 1)


@pytest.mark.parametrize("rate", [5, 10, 20, 30])
def test_occluded_track_lasts_equally_long_at_any_rate(rate):
    def started(hidden):
        frames = [make_detections(make_car(10))] * (4 * rate) + [Detections.none()] * int(hidden * rate)
        tracker = Tracker()
        track(
            [*frames, make_detections(make_car(10))],
            tracker=tracker,
            stamps=[START + i * 10**9 // rate for i in range(len(frames) + 1)],
        )
        return tracker.started_count

    assert (started(1.4), started(2.0)) == (1, 2)


def test_weak_detections_continue_tracks_but_start_none():
    weak = TrackingParams().association.strong / 2
    tracker = Tracker()
    track([make_detections(make_car(10), scores=weak)] * 10, tracker=tracker)
    assert (tracker.started_count, tracker.alive_count) == (0, 0)
    tracks = track(
        [make_detections(make_car(10))] * 10 + [make_detections(make_car(10), scores=weak)] * 3,
        tracker=tracker,
        stamps=[START + (20 + i) * TENTH for i in range(13)],
    )
    assert tracks[-1].ids.tolist() == [1] and tracks[-1].seen[0]


def test_repeated_observations_add_less_evidence():
    looks = np.arange(1.0, 500.0)
    once = discount_observations(looks, 0.5)
    assert once[0] == 1 and (np.diff(once) > 0).all() and once[-1] < 1 / 0.5
    np.testing.assert_allclose(discount_observations(looks, 0.0), looks)


def test_constantly_low_scores_keep_the_track_score_low():
    """A neutral score adds no evidence, however often it occurs."""
    neutral = TrackingParams().existence.neutral
    tracker = Tracker(with_values(TrackingParams(), {"report": 0.0}))
    tracks = track([make_detections(make_person(15), scores=neutral, kind=PEDESTRIAN)] * 100, tracker=tracker)
    assert max(t.detections.scores.max(initial=0) for t in tracks) < 0.6
    better = track([make_detections(make_person(15), scores=0.6, kind=PEDESTRIAN)] * 10)[-1]
    assert better.detections.scores[0] > 0.7


def test_reversed_heading_detections_do_not_turn_a_car():
    tracks = track([make_detections(make_car(10 + i, yaw=np.pi * (i % 2))) for i in range(20)])
    assert [wrap_angle(t.detections.boxes[0, 6]) for t in tracks[6:]] == pytest.approx([0.0] * 14, abs=0.1)


@pytest.mark.parametrize("at", [None, make_flat_pose(0)])
@pytest.mark.parametrize("speed", [-1.0, 0.0])
def test_slow_object_heading_follows_majority_of_scores(at, speed):
    flipped = np.random.default_rng(0).random(60) < 0.25
    flipped[:3] = True
    tracks = track(
        [make_detections(make_car(10 + 0.1 * speed * i, yaw=np.pi * wrong)) for i, wrong in enumerate(flipped)],
        [at] * 60,
    )
    headings = wrap_angle(np.array([t.detections.boxes[0, 6] for t in tracks]))
    assert np.abs(np.abs(headings[:3]) - np.pi).max() < 0.01
    assert np.abs(headings[15:]).max() < 0.01 and {t.ids.tolist()[0] for t in tracks} == {1}


def test_moving_object_heading_follows_motion():
    tracks = track([make_detections(make_car(10 + 0.6 * i, yaw=np.pi)) for i in range(40)], [make_flat_pose(0)] * 40)
    assert [wrap_angle(t.detections.boxes[0, 6]) for t in tracks[6:]] == pytest.approx([0.0] * 34, abs=0.1)


def test_alternating_classes_are_one_track_of_the_better_class():
    frames = [
        make_detections(make_person(10 + 0.1 * i), kind=[CYCLIST, PEDESTRIAN][i % 2], scores=[0.6, 0.9][i % 2])
        for i in range(30)
    ]
    tracks = track(frames)
    assert {t.ids.tolist()[0] for t in tracks[1:]} == {tracks[-1].ids[0]}
    assert {int(t.detections.class_ids[0]) for t in tracks[8:]} == {PEDESTRIAN}


def test_one_of_two_overlapping_tracks_ends():
    both = Detections.of([make_car(10), make_car(10.3)], CAR, [0.9, 0.8])
    assert all(len(t) == 1 for t in track([both] * 5))


def test_tracks_are_predicted_over_a_lost_frame():
    tracker = Tracker()
    track([make_detections(make_car(10 + i)) for i in range(10)], tracker=tracker)
    later = tracker.predict(START + 9 * TENTH + 2 * TENTH)
    assert later.detections.boxes[0, 0] == pytest.approx(21, abs=0.3)
    assert len(tracker.predict(0)) == 1 and len(Tracker().predict(5)) == 0


def test_missing_equal_late_and_jumping_stamps_are_handled():
    tracker, found = Tracker(), make_detections(make_car(10))
    for _ in range(3):
        tracker(found, 0)
        assert "no stamps" in tracker.problem
    assert len(tracker(found, 0)) == 1
    tracker = Tracker()
    track([found] * 5, tracker=tracker)
    for stamp, words in ((START + 4 * TENTH, "ignored"), (START + 2 * TENTH, "older")):
        assert tracker(found, stamp).ids.tolist() == [1] and words in tracker.problem
    assert tracker(found, START - 10**10).ids.tolist() == [2] and "jumped" in tracker.problem
    assert tracker(found, START).ids.tolist() == [3] and "jumped" in tracker.problem
    tracker(found, START + TENTH)
    assert tracker.problem is None


def test_short_loop_is_a_time_jump_and_not_late_frames():
    tracker, short = Tracker(), [START + i * TENTH for i in range(6)]
    tracks = track([make_detections(make_car(10))] * 18, tracker=tracker, stamps=short * 3)
    assert tracker.ended_count == 2
    assert [t.ids.tolist()[-1] for t in tracks] == [1] * 7 + [2] * 6 + [3] * 5
    # several late frames in a row change nothing
    tracker = Tracker()
    stamps = [START + i * TENTH for i in (0, 1, 4, 3, 2, 5)]
    tracks = track([make_detections(make_car(10))] * 6, tracker=tracker, stamps=stamps)
    assert tracks[-1].ids.tolist() == [1] and tracker.ended_count == 0


def test_missing_poses_are_extrapolated():
    frames = [make_detections(make_car(40 - 0.8 * i)) for i in range(20)]
    poses = [None if 8 <= i < 13 else make_flat_pose(0.8 * i) for i in range(20)]
    tracker = Tracker()
    tracks = track(frames, poses, tracker)
    assert {t.ids.tolist()[0] for t in tracks} == {1}
    assert np.abs(tracks[-1].velocities).max() < 0.3
    tracker(frames[-1], START + 20 * TENTH, np.full((4, 4), np.nan))
    assert "pose is missing" in tracker.problem
    tracker(frames[-1], START + 21 * TENTH, make_flat_pose(5000.0))
    assert "pose jumped" in tracker.problem and tracker.alive_count == 1


def test_ego_motion_is_extrapolated_up_to_max_gap():
    ego = advance_ego(advance_ego(Ego.unknown(), make_flat_pose(0), 0.1, 1.0), make_flat_pose(1, 0.1, 0.05), 0.1, 1.0)
    step = np.linalg.inv(make_flat_pose(0)) @ make_flat_pose(1, 0.1, 0.05)
    on = advance_ego(ego, None, 0.1, 1.0)
    np.testing.assert_allclose(on.pose, make_flat_pose(1, 0.1, 0.05) @ step, atol=2e-2)
    long = advance_ego(advance_ego(ego, None, 5.0, 1.0), None, 5.0, 1.0)
    np.testing.assert_allclose(long.pose, advance_ego(ego, None, 1.0, 1.0).pose)
    assert not is_valid_pose(2 * np.eye(4)) and not is_valid_pose(np.eye(3)) and not is_valid_pose(None)


def test_invalid_boxes_are_ignored():
    good = make_car(10)
    bad = [make_car(np.nan), [*good[:3], 0.0, 1.8, 1.5, 0.0], make_car(np.inf), make_car(1e9)]
    tracker = Tracker()
    tracks = track([Detections.of([good, *bad], CAR, 0.9)] * 4, tracker=tracker)
    assert tracker.started_count == 1 and "4 of 5" in tracker.problem
    assert np.isfinite(tracks[-1].detections.boxes).all()
    tracker(Detections.of([good], CAR, np.nan), START + 5 * TENTH)
    assert "1 of 1" in tracker.problem


def test_ten_thousand_detections_stay_within_limits():
    rng = np.random.default_rng(0)
    tracker = Tracker(with_values(TrackingParams(), {"max_detections": 100, "max_tracks": 80}))
    for i in range(5):
        boxes = np.tile(make_car(0), (10_000, 1))
        boxes[:, :2] = rng.uniform(-70, 70, (10_000, 2))
        tracks = tracker(Detections.of(boxes, rng.integers(0, 9, 10_000), rng.uniform(0, 1, 10_000)), START + i * TENTH)
        assert tracker.alive_count <= 80 and len(tracks) <= 80
        assert "with the highest scores are used" in tracker.problem


def test_assignment_maximizes_pairs_within_gates():
    tracks = np.array([make_car(0), make_car(2), make_car(100)])
    found = np.array([make_car(1.2), make_car(-0.4), make_car(50)])
    kinds = np.zeros(3, int)
    pairs = find_pairs(tracks, np.full(3, 0.3), kinds, np.full(3, 1.5), found, kinds, AssociationParams())
    assert {2} & {*pairs.tracks.tolist(), *pairs.boxes.tolist()} == set()
    assert [p.tolist() for p in assign(pairs)] == [[0, 1], [1, 0]]
    none = find_pairs(np.zeros((0, 7)), *[np.zeros(0, int)] * 3, found, kinds, AssociationParams())
    assert [len(p) for p in assign(none)] == [0, 0]


@pytest.mark.parametrize(("count", "overlap"), [(1, 0.5), (40, 0.5), (40, 0.0), (150, 1.0)])
def test_sparse_assignment_equals_dense_one(count, overlap):
    """The reference assigns with costs of all pairs of tracks and detections."""
    rng, params = np.random.default_rng(count), AssociationParams(overlap=overlap)
    extent = 2.5 * np.sqrt(count)
    tracks = np.column_stack(
        [
            rng.uniform(0, extent, (count, 2)),
            np.zeros(count),
            rng.uniform(0.5, 4, (count, 3)),
            rng.uniform(-4, 4, count),
        ]
    )
    found = tracks[rng.permutation(count)] + rng.normal(0, 0.5, (count, 7)) * [1, 1, 0, 0, 0, 0, 1]
    found = np.concatenate([found, tracks[:1] + 0.1])
    kinds, box_kinds = rng.integers(0, 3, count), rng.integers(0, 3, count + 1)
    spread, reach = rng.uniform(0.1, 1.0, count), np.full(count, 1.5)
    distance = np.linalg.norm(tracks[:, None, :2] - found[None, :, :2], axis=-1)
    gate = np.clip(params.sigmas * spread, reach, params.max_gate)[:, None]
    cost = (1 - overlap) * distance / gate + overlap * (1 - bev_iou(tracks, found))
    differ = kinds[:, None] != box_kinds
    cost += params.other_kind * differ * np.where((kinds[:, None] > 0) & (box_kinds > 0), 0.5, 1)
    cost[(distance > gate) | (cost > 1)] = 1e5
    rows, columns = linear_sum_assignment(cost)
    allowed = cost[rows, columns] < 1e5
    pairs = find_pairs(tracks, spread, kinds, reach, found, box_kinds, params)
    assert len(pairs.costs) == (cost < 1e5).sum()
    np.testing.assert_allclose(pairs.costs, cost[pairs.tracks, pairs.boxes], atol=1e-12)
    i, j = assign(pairs)
    assert (i.tolist(), j.tolist()) == (rows[allowed].tolist(), columns[allowed].tolist())


def test_parked_cars_keep_ids_from_turning_car_without_poses():
    """Parked cars move sideways in the sensor's frame, so heading must not constrain motion."""
    parked = np.array([make_car(25, 4), make_car(32, -6, 0.1), make_car(40, 5)])
    frames = [
        Detections.of(transform_boxes(parked, np.linalg.inv(make_flat_pose(0.6 * i, 0.0, 0.02 * i))), CAR, 0.9)
        for i in range(25)
    ]
    tracks = track(frames)
    assert {tuple(t.ids.tolist()) for t in tracks} == {(1, 2, 3)}
    for t, found in zip(tracks[5:], frames[5:]):
        np.testing.assert_allclose(t.detections.boxes[:, :2], found.boxes[:, :2], atol=0.3)


def test_high_speed_lowers_the_pedestrian_probability():
    """This needs poses: relative to a moving sensor everything is fast."""

    def score(speed, at):
        frames = [make_detections(make_person(20 + 0.1 * speed * i), kind=PEDESTRIAN, scores=0.7) for i in range(20)]
        tracker = Tracker(with_values(TrackingParams(), {"report": 0.0}))
        for i, found in enumerate(frames):
            tracks = tracker(found, START + i * TENTH, at)
        assert tracks.ids.tolist() == [1]
        return tracks.detections.scores[0]

    assert score(1.5, make_flat_pose(0)) > score(0.0, make_flat_pose(0)) > score(4.0, make_flat_pose(0))
    assert score(4.0, make_flat_pose(0)) < score(4.0, None)


@pytest.mark.parametrize("kind", [PEDESTRIAN, CYCLIST])
def test_constant_heading_error_does_not_shift_track(kind):
    """Heading errors of a detector are correlated over time."""
    speed = 5.0 if kind == CYCLIST else 1.5
    frames = [make_detections([10 + 0.1 * speed * i, 3, -0.8, 1.7, 0.6, 1.7, 0.25], kind=kind) for i in range(30)]
    last = track(frames, [np.eye(4)] * 30)[-1]
    assert abs(last.detections.boxes[0, 1] - 3) < 0.02 and abs(last.velocities[0, 1]) < 0.05
    assert abs(wrap_angle(last.detections.boxes[0, 6])) < 0.05  # the heading follows the motion

"""The tracker: ids that stay, velocities that are right, evidence, and input that is broken."""

from __future__ import annotations

import numpy as np
import pytest
from tracking_samples import CAR, CYCLIST, START, TENTH, car, cars, crowd, person, pose

from lidar_perception.geometry import wrap_angle
from lidar_perception.param_fields import with_values
from lidar_perception.robot.placement import make_tilted_pose
from lidar_perception.robot.poses import transform_boxes
from lidar_perception.tracking.association import FORBIDDEN, assigned, costs
from lidar_perception.tracking.ego import Ego, next_ego, usable
from lidar_perception.tracking.existence import effective_looks
from lidar_perception.tracking.params import AssociationParams, TrackingParams
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.types import PEDESTRIAN, Detections


def followed(frames, poses=None, tracker=None, stamps=None):
    """The Tracks of every frame, at 10 Hz."""
    tracker = tracker or Tracker()
    return [tracker(found, START + i * TENTH if stamps is None else stamps[i],
                    None if poses is None else poses[i]) for i, found in enumerate(frames)]


def test_ids_stay_and_velocities_are_right():
    tracks = followed(crowd())
    assert {t.ids.tolist() == [1, 2, 3, 4, 5, 6] for t in tracks} == {True}
    last = tracks[-1]
    truth = np.array([[8, 0], [-5, 0], [4, 0], [1, 0.5], [0, 0], [-1, 0]])
    off = last.velocities - truth
    assert np.abs(off).max() < 0.5
    inside = np.einsum("ni,nij,nj->n", off, np.linalg.inv(last.covariances[:, 2:4, 2:4]), off)
    assert (inside < 16).all()  # the covariances do not promise too much
    assert (np.linalg.eigvalsh(last.covariances) > -1e-12).all()
    assert (last.moving[[0, 1, 2]] > 0.99).all() and last.moving[4] < 0.3


@pytest.mark.parametrize("rate", [20, 10, 5, 2])
def test_a_car_on_a_fast_road_is_one_track_at_any_rate(rate):
    frames = [cars(car(-60 + 28.0 * i / rate)) for i in range(20)]
    *_, last = followed(frames, [np.eye(4)] * 20, stamps=[
        START + i * 10**9 // rate for i in range(20)])
    assert last.ids.tolist() == [1]
    np.testing.assert_allclose(last.velocities, [[28, 0]], atol=0.5)


def test_the_same_frames_give_the_same_tracks_and_nothing_given_is_changed():
    frames = list(crowd(3))
    before = [f.boxes.copy() for f in frames]
    first, again = followed(frames), followed(frames)
    for a, b in zip(first, again):
        for name in ("ids", "velocities", "covariances", "moving"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        np.testing.assert_array_equal(a.detections.boxes, b.detections.boxes)
    for frame, boxes in zip(frames, before):
        np.testing.assert_array_equal(frame.boxes, boxes)


@pytest.mark.parametrize("hung", [0.0, np.pi])
def test_a_sensor_that_moves_and_turns_sees_the_same_tracks_as_one_that_stands(hung):
    """Upside down, too."""
    frames = list(crowd(1))
    poses = [pose(0.9 * i, 0.1 * i, 0.04 * i) @ make_tilted_pose(hung, 0.0)
             for i in range(len(frames))]
    moved = [Detections.of(transform_boxes(f.boxes, np.linalg.inv(p)), f.class_ids, f.scores)
             for f, p in zip(frames, poses)]
    standing = followed(frames, [np.eye(4)] * len(frames))
    for still, seen, p in zip(standing, followed(moved, poses), poses):
        assert seen.ids.tolist() == still.ids.tolist()
        back = transform_boxes(seen.detections.boxes, p)
        np.testing.assert_allclose(back[:, :6], still.detections.boxes[:, :6], atol=1e-3)
        assert np.abs(wrap_angle(back[:, 6] - still.detections.boxes[:, 6])).max() < 1e-3
        np.testing.assert_allclose(seen.velocities @ p[:2, :2].T, still.velocities, atol=1e-3)
        side = np.linalg.det(p[:2, :2])
        np.testing.assert_allclose(side * seen.turn_rates, still.turn_rates, atol=1e-3)
        np.testing.assert_allclose(
            p[:2, :2] @ seen.covariances[:, 2:4, 2:4] @ p[:2, :2].T,
            still.covariances[:, 2:4, 2:4], atol=1e-3)
        np.testing.assert_allclose(seen.moving, still.moving, atol=1e-3)


def test_without_poses_what_stands_comes_nearer():
    frames = [cars(car(30 - 0.8 * i)) for i in range(15)]
    alone = followed(frames)[-1]
    assert alone.velocities[0] == pytest.approx([-8, 0], abs=0.3) and alone.moving[0] > 0.99
    known = followed(frames, [pose(0.8 * i) for i in range(15)])[-1]
    assert known.velocities[0] == pytest.approx([0, 0], abs=0.2) and known.moving[0] < 0.4


def test_a_car_on_a_circle_shows_its_turn_rate():
    angle = np.arange(40) * 0.04  # 0.4 rad/s, 4 m/s
    tracks = followed([cars(car(10 * np.sin(a), 10 - 10 * np.cos(a), a)) for a in angle])
    last = tracks[-1]
    assert last.ids.tolist() == [1] and last.turn_rates[0] == pytest.approx(0.4, abs=0.08)
    assert wrap_angle(last.detections.boxes[0, 6] - angle[-1]) == pytest.approx(0, abs=0.1)
    assert np.hypot(*last.velocities[0]) == pytest.approx(4, abs=0.4)


def test_a_missed_frame_keeps_id_and_place():
    frames = [cars(car(10 + i)) if i not in (8, 9) else Detections.none() for i in range(14)]
    tracks = followed(frames)
    assert {t.ids.tolist()[0] for t in tracks if len(t)} == {1}
    assert tracks[8].ids.tolist() == [1] and not tracks[8].seen[0]
    assert tracks[8].detections.boxes[0, 0] == pytest.approx(18, abs=0.5)
    assert tracks[12].detections.boxes[0, 0] == pytest.approx(22, abs=0.3)


def test_what_is_gone_ends():
    tracker = Tracker()
    followed([cars(car(10))] * 5 + [Detections.none()] * 60, tracker=tracker)
    assert (tracker.alive, tracker.born, tracker.ended) == (0, 1, 1)


@pytest.mark.parametrize("rate", [5, 10, 20, 30])
def test_what_is_hidden_is_remembered_for_as_long_at_any_rate(rate):
    def born(hidden):
        frames = [cars(car(10))] * (4 * rate) + [Detections.none()] * int(hidden * rate)
        tracker = Tracker()
        followed([*frames, cars(car(10))], tracker=tracker,
                 stamps=[START + i * 10**9 // rate for i in range(len(frames) + 1)])
        return tracker.born
    assert (born(1.4), born(2.0)) == (1, 2)


def test_a_weak_detection_keeps_a_track_alive_and_starts_none():
    weak = TrackingParams().association.strong / 2
    tracker = Tracker()
    followed([cars(car(10), scores=weak)] * 10, tracker=tracker)
    assert (tracker.born, tracker.alive) == (0, 0)
    tracks = followed([cars(car(10))] * 10 + [cars(car(10), scores=weak)] * 3, tracker=tracker,
                      stamps=[START + (20 + i) * TENTH for i in range(13)])
    assert tracks[-1].ids.tolist() == [1] and tracks[-1].seen[0]


def test_looks_at_one_object_count_little_more_than_one():
    looks = np.arange(1.0, 500.0)
    once = effective_looks(looks, 0.5)
    assert once[0] == 1 and (np.diff(once) > 0).all() and once[-1] < 1 / 0.5
    np.testing.assert_allclose(effective_looks(looks, 0.0), looks)


def test_a_post_that_is_doubtful_in_every_frame_never_becomes_sure():
    """A score that says nothing for it, a hundred times from the same place, says nothing."""
    neutral = TrackingParams().existence.neutral
    tracker = Tracker(with_values(TrackingParams(), {"report": 0.0}))
    tracks = followed([cars(person(15), scores=neutral, kind=PEDESTRIAN)] * 100, tracker=tracker)
    assert max(t.detections.scores.max(initial=0) for t in tracks) < 0.6
    better = followed([cars(person(15), scores=0.6, kind=PEDESTRIAN)] * 10)[-1]
    assert better.detections.scores[0] > 0.7


def test_a_front_taken_for_the_rear_does_not_turn_a_car():
    tracks = followed([cars(car(10 + i, yaw=np.pi * (i % 2))) for i in range(20)])
    assert [wrap_angle(t.detections.boxes[0, 6]) for t in tracks[6:]] == pytest.approx(
        [0.0] * 14, abs=0.1)


@pytest.mark.parametrize("at", [None, pose(0)])
@pytest.mark.parametrize("speed", [-1.0, 0.0])
def test_the_front_of_what_stands_or_creeps_is_where_most_scores_say(at, speed):
    """Not where the first detection said."""
    flipped = np.random.default_rng(0).random(60) < 0.25
    flipped[:3] = True
    tracks = followed([cars(car(10 + 0.1 * speed * i, yaw=np.pi * wrong))
                       for i, wrong in enumerate(flipped)], [at] * 60)
    headings = wrap_angle(np.array([t.detections.boxes[0, 6] for t in tracks]))
    assert np.abs(np.abs(headings[:3]) - np.pi).max() < 0.01
    assert np.abs(headings[15:]).max() < 0.01 and {t.ids.tolist()[0] for t in tracks} == {1}


def test_the_front_of_what_drives_is_ahead_whatever_detections_say():
    tracks = followed([cars(car(10 + 0.6 * i, yaw=np.pi)) for i in range(40)], [pose(0)] * 40)
    assert [wrap_angle(t.detections.boxes[0, 6]) for t in tracks[6:]] == pytest.approx(
        [0.0] * 34, abs=0.1)


def test_a_class_that_changes_each_frame_is_one_track_of_the_better_one():
    frames = [cars(person(10 + 0.1 * i), kind=[CYCLIST, PEDESTRIAN][i % 2],
                   scores=[0.6, 0.9][i % 2]) for i in range(30)]
    tracks = followed(frames)
    assert {t.ids.tolist()[0] for t in tracks[1:]} == {tracks[-1].ids[0]}
    assert {int(t.detections.class_ids[0]) for t in tracks[8:]} == {PEDESTRIAN}


def test_of_two_tracks_in_one_place_one_ends():
    both = Detections.of([car(10), car(10.3)], CAR, [0.9, 0.8])
    assert all(len(t) == 1 for t in followed([both] * 5))


def test_a_frame_that_is_lost_is_predicted_over():
    tracker = Tracker()
    followed([cars(car(10 + i)) for i in range(10)], tracker=tracker)
    later = tracker.at(START + 9 * TENTH + 2 * TENTH)
    assert later.detections.boxes[0, 0] == pytest.approx(21, abs=0.3)
    assert len(tracker.at(0)) == 1 and len(Tracker().at(5)) == 0


def test_stamps_that_are_missing_equal_late_or_jump():
    tracker, found = Tracker(), cars(car(10))
    for _ in range(3):
        tracker(found, 0)
        assert "no stamps" in tracker.problem
    assert len(tracker(found, 0)) == 1
    tracker = Tracker()
    followed([found] * 5, tracker=tracker)
    for stamp, words in ((START + 4 * TENTH, "left out"), (START + 2 * TENTH, "older")):
        assert tracker(found, stamp).ids.tolist() == [1] and words in tracker.problem
    assert tracker(found, START - 10**10).ids.tolist() == [2] and "jumped" in tracker.problem
    assert tracker(found, START).ids.tolist() == [3] and "jumped" in tracker.problem
    tracker(found, START + TENTH)
    assert tracker.problem is None


def test_a_loop_that_is_shorter_than_the_longest_gap_is_a_jump_and_no_row_of_late_frames():
    tracker, short = Tracker(), [START + i * TENTH for i in range(6)]
    tracks = followed([cars(car(10))] * 18, tracker=tracker, stamps=short * 3)
    assert tracker.ended == 2
    assert [t.ids.tolist()[-1] for t in tracks] == [1] * 7 + [2] * 6 + [3] * 5
    # one after the other, frames that are late do no harm
    tracker = Tracker()
    stamps = [START + i * TENTH for i in (0, 1, 4, 3, 2, 5)]
    tracks = followed([cars(car(10))] * 6, tracker=tracker, stamps=stamps)
    assert tracks[-1].ids.tolist() == [1] and tracker.ended == 0


def test_poses_that_are_missing_for_a_while_are_replaced_by_the_motion_before():
    frames = [cars(car(40 - 0.8 * i)) for i in range(20)]
    poses = [None if 8 <= i < 13 else pose(0.8 * i) for i in range(20)]
    tracker = Tracker()
    tracks = followed(frames, poses, tracker)
    assert {t.ids.tolist()[0] for t in tracks} == {1}
    assert np.abs(tracks[-1].velocities).max() < 0.3
    tracker(frames[-1], START + 20 * TENTH, np.full((4, 4), np.nan))
    assert "pose is missing" in tracker.problem
    tracker(frames[-1], START + 21 * TENTH, pose(5000.0))
    assert "pose jumped" in tracker.problem and tracker.alive == 1


def test_ego_motion_goes_on_as_before_for_a_while():
    ego = next_ego(next_ego(Ego.unknown(), pose(0), 0.1, 1.0), pose(1, 0.1, 0.05), 0.1, 1.0)
    step = np.linalg.inv(pose(0)) @ pose(1, 0.1, 0.05)
    on = next_ego(ego, None, 0.1, 1.0)
    np.testing.assert_allclose(on.pose, pose(1, 0.1, 0.05) @ step, atol=2e-2)
    long = next_ego(next_ego(ego, None, 5.0, 1.0), None, 5.0, 1.0)
    np.testing.assert_allclose(long.pose, next_ego(ego, None, 1.0, 1.0).pose)
    assert not usable(2 * np.eye(4)) and not usable(np.eye(3)) and not usable(None)


def test_boxes_that_are_none_are_left_out():
    good = car(10)
    bad = [car(np.nan), [*good[:3], 0.0, 1.8, 1.5, 0.0], car(np.inf), car(1e9)]
    tracker = Tracker()
    tracks = followed([Detections.of([good, *bad], CAR, 0.9)] * 4, tracker=tracker)
    assert tracker.born == 1 and "4 of 5" in tracker.problem
    assert np.isfinite(tracks[-1].detections.boxes).all()
    tracker(Detections.of([good], CAR, np.nan), START + 5 * TENTH)
    assert "1 of 1" in tracker.problem


def test_ten_thousand_detections_a_frame_stay_within_bounds():
    rng = np.random.default_rng(0)
    tracker = Tracker(with_values(TrackingParams(), {"max_detections": 100, "max_tracks": 80}))
    for i in range(5):
        boxes = np.tile(car(0), (10_000, 1))
        boxes[:, :2] = rng.uniform(-70, 70, (10_000, 2))
        tracks = tracker(Detections.of(boxes, rng.integers(0, 9, 10_000),
                                       rng.uniform(0, 1, 10_000)), START + i * TENTH)
        assert tracker.alive <= 80 and len(tracks) <= 80
        assert "too many" in tracker.problem


def test_the_assignment_makes_most_pairs_within_gates_and_forbids_the_rest():
    tracks = np.array([car(0), car(2), car(100)])
    found = np.array([car(1.2), car(-0.4), car(50)])
    kinds = np.zeros(3, int)
    cost = costs(tracks, np.full(3, 0.3), kinds, np.full(3, 1.5), found, kinds,
                 AssociationParams())
    assert (cost[2] == FORBIDDEN).all() and (cost[:, 2] == FORBIDDEN).all()
    assert [p.tolist() for p in assigned(cost)] == [[0, 1], [1, 0]]
    assert len(assigned(np.zeros((0, 4)))[0]) == 0


def test_parked_cars_seen_from_a_turning_car_without_poses_keep_their_ids():
    """They move sideways in the sensor's frame: nothing may tie their motion to their heading."""
    parked = np.array([car(25, 4), car(32, -6, 0.1), car(40, 5)])
    frames = [Detections.of(transform_boxes(parked, np.linalg.inv(pose(0.6 * i, 0.0, 0.02 * i))),
                            CAR,
                            0.9) for i in range(25)]
    tracks = followed(frames)
    assert {tuple(t.ids.tolist()) for t in tracks} == {(1, 2, 3)}
    for t, found in zip(tracks[5:], frames[5:]):
        np.testing.assert_allclose(t.detections.boxes[:, :2], found.boxes[:, :2], atol=0.3)



def test_who_is_faster_than_anyone_walks_is_no_pedestrian():
    """Where poses say what stands; relative to a sensor that moves, all is fast."""
    def score(speed, at):
        frames = [cars(person(20 + 0.1 * speed * i), kind=PEDESTRIAN, scores=0.7)
                  for i in range(20)]
        tracker = Tracker(with_values(TrackingParams(), {"report": 0.0}))
        for i, found in enumerate(frames):
            tracks = tracker(found, START + i * TENTH, at)
        assert tracks.ids.tolist() == [1]
        return tracks.detections.scores[0]
    assert score(1.5, pose(0)) > score(0.0, pose(0)) > score(4.0, pose(0))
    assert score(4.0, pose(0)) < score(4.0, None)


@pytest.mark.parametrize("kind", [PEDESTRIAN, CYCLIST])
def test_a_heading_that_is_always_a_little_off_does_not_push_a_track_aside(kind):
    """As detectors measure it: not a new error in each frame, but much the same one."""
    speed = 5.0 if kind == CYCLIST else 1.5
    frames = [cars([10 + 0.1 * speed * i, 3, -0.8, 1.7, 0.6, 1.7, 0.25], kind=kind)
              for i in range(30)]
    last = followed(frames, [np.eye(4)] * 30)[-1]
    assert abs(last.detections.boxes[0, 1] - 3) < 0.02 and abs(last.velocities[0, 1]) < 0.05
    assert abs(wrap_angle(last.detections.boxes[0, 6])) < 0.05  # it is headed where it goes

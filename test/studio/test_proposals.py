"""Tests of proposals for a simulated drive, from seeds only."""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidar_perception.classes import CAR, PEDESTRIAN
from lidar_perception.data.frame import BOXES, POSES, Recording
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.geometry import points_in_box
from lidar_perception.simulation.recording import simulate_frames
from lidar_perception.types import InputError
from lidar_studio import survey_cache
from lidar_studio.actions import apply
from lidar_studio.drive import Drive
from lidar_studio.journal import JOURNAL_NAME
from lidar_studio.session import open_session
from lidar_studio.snap import snap_to_cluster, snap_to_ground
from lidar_studio.state import KEY, PROPOSED, Box, State, track_to_json

SEED, FRAMES = 119, 6  # a street with people near and far
CAR_SEED = 64  # a street with several cars


def simulate_street(seed, count=FRAMES):
    frames = list(simulate_frames(seed, count, frames_per_drive=20))
    return Drive("simulated", Recording(Path("simulated"), "simulated", frames, frozenset({BOXES, POSES})))


@pytest.fixture(scope="module")
def drive(streets):
    return simulate_street(SEED)


@pytest.fixture
def session(drive, tmp_path):
    """A session without labels and without a detector."""
    with open_session(drive, tmp_path, detector=None) as session:
        yield session


def find_nearest_person(session):
    """Return the nearest labelled person: boxes by frame, the first frame, and one of the points."""
    people = {}
    for f, frame in enumerate(session.drive.frames):
        truth = frame.truth()
        for box, extra in zip(
            truth.boxes[truth.class_ids == PEDESTRIAN], np.array(truth.extras)[truth.class_ids == PEDESTRIAN]
        ):
            people.setdefault(extra["track_id"], {})[f] = box
    boxes = min(people.values(), key=lambda b: np.hypot(*next(iter(b.values()))[:2]))
    frame = min(boxes)
    scan = session.drive.load_scan(frame)
    inside = scan.xyz[points_in_box(scan.xyz, boxes[frame]) & (scan.cluster_ids > 0)]
    return boxes, frame, inside[len(inside) // 2].tolist()


def click_person(session):
    """Click the nearest person; return the labelled boxes and the new track."""
    boxes, frame, xyz = find_nearest_person(session)
    session.execute({"do": "seed", "frame": frame, "xyz": xyz, "class": "Pedestrian"})
    return boxes, session.state.tracks[session.state.seeds[-1][1]]


def test_clicked_person_is_tracked_through_the_drive(session):
    session.propose()
    assert not session.state.tracks  # no proposals without a detector and seeds
    boxes, track = click_person(session)
    assert len(boxes) >= FRAMES - 1 and boxes.keys() <= track.boxes.keys()
    distances = [np.hypot(*(np.array(track.boxes[f].values)[:2] - b[:2])) for f, b in boxes.items()]
    assert max(distances) < 0.5
    assert all(
        t.class_name == "Pedestrian" and t.state == PROPOSED for t in session.state.tracks.values() if t.id != track.id
    )


def get_tracks_without_ids(session):
    """Return all tracks without their ids, which depend on the order in which they were found."""
    return {
        (t.class_name, t.state, t.source, t.score, tuple(sorted(t.boxes.items())))
        for t in session.state.tracks.values()
    }


def test_nearby_frames_of_a_click_are_tracked_first(session, drive, tmp_path, monkeypatch):
    session.propose()
    click_person(session)
    expected = get_tracks_without_ids(session)
    with open_session(drive, tmp_path / "long", detector=None) as long_session:
        long_session.propose()
        old_state = long_session.state
        monkeypatch.setattr("lidar_studio.session.NEARBY_FRAMES", 1)
        _, frame, xyz = find_nearest_person(long_session)
        track_lists = []
        long_session.listeners.append(lambda event: track_lists.append(event.get("tracks")))
        long_session.execute({"do": "seed", "frame": frame, "xyz": xyz, "class": "Pedestrian"})
        long_session.wait()
        first_tracks = next(tracks for tracks in track_lists if tracks)
        assert {row[0] for t in first_tracks for row in t["boxes"]} <= {frame, frame + 1}
        assert get_tracks_without_ids(long_session) == expected
        long_session.execute({"do": "undo"})  # undoes the seed and its proposals
        assert long_session.state.tracks == old_state.tracks and long_session.state.seeds == old_state.seeds


def test_seed_is_applied_once_and_its_tracks_are_encoded_once(session, monkeypatch):
    session.propose()
    apply_calls, encoded_ids = [], []
    monkeypatch.setattr("lidar_studio.session.apply", lambda *args: apply_calls.append(args) or apply(*args))
    monkeypatch.setattr(
        "lidar_studio.session.track_to_json", lambda track: encoded_ids.append(track.id) or track_to_json(track)
    )
    monkeypatch.setattr("lidar_studio.state.track_from_json", None)
    click_person(session)
    assert len(apply_calls) == 1
    assert encoded_ids and len(set(encoded_ids)) == len(encoded_ids)


def test_clicked_car_is_a_seed_and_similar_cars_are_proposed(streets, tmp_path):
    with open_session(simulate_street(CAR_SEED, 2), tmp_path, detector=None) as session:
        check_proposals_of_clicked_car(session)


def check_proposals_of_clicked_car(session):
    session.propose()
    frame = session.drive.frames[0]
    truth, scan = frame.truth(), session.drive.load_scan(0)
    cars = truth.select_class(CAR)
    points_by_car = [scan.xyz[points_in_box(scan.xyz, b) & (scan.cluster_ids > 0)] for b in cars]
    best = max(range(len(cars)), key=lambda k: len(points_by_car[k]))
    points, car = points_by_car[best], cars[best]
    central_point = points[np.linalg.norm(points - car[:3], axis=1).argmin()]
    session.execute({"do": "seed", "frame": 0, "xyz": central_point.tolist(), "class": "Car"})
    clicked_track = session.state.tracks[session.state.seeds[-1][1]]
    assert clicked_track.class_name == "Car" and math.dist(clicked_track.boxes[0].values[:2], car[:2]) < 1.5
    proposals = [t for t in session.state.tracks.values() if t.id != clicked_track.id]
    assert proposals and all(t.class_name == "Car" and t.state == PROPOSED for t in proposals)
    scores = [t.score for t in sorted(proposals, key=lambda t: t.id)]
    assert scores == sorted(scores, reverse=True)
    with pytest.raises(InputError, match="no pedestrian seed"):
        session.proposer.compare_with_seed(session.state, clicked_track, 0)


def run_survey(drive, folder, last_count=FRAMES):
    """Survey up to `last_count` frames; return the progress, the messages and the tracks."""
    progress, messages = [], []
    with open_session(drive, folder, detector=None) as session:
        session.listeners.append(lambda event: messages.append(event.get("error", "")))
        run = session.proposer.run_survey

        def report(count, on_progress):
            progress.append(count)
            return on_progress(count) and not count == last_count < FRAMES

        session.proposer.run_survey = lambda f: run(lambda count: report(count, f))
        session.propose()
        if last_count == FRAMES:
            click_person(session)
    return progress, "".join(messages), get_tracks_without_ids(session)


def read_cache(folder):
    return {p.name: p.read_bytes() for p in (folder / survey_cache.FOLDER).iterdir()}


@pytest.mark.parametrize("has_poses", [True, False])
def test_cancelled_survey_is_resumed(drive, tmp_path, monkeypatch, has_poses):
    monkeypatch.setattr(survey_cache, "FRAMES_PER_FILE", 2)
    if not has_poses:  # KISS-ICP then computes the poses, scan after scan
        pytest.importorskip("kiss_icp")
        frames = [replace(frame, pose=lambda: None) for frame in drive.frames]
        drive = Drive("simulated", Recording(Path("simulated"), "simulated", frames))
    complete = run_survey(drive, tmp_path / "complete")
    assert complete[:2] == ([1, 2, 3, 4, 5, 6], "")
    cancelled = run_survey(drive, tmp_path / "cancelled", last_count=5)
    assert cancelled == ([1, 2, 3, 4, 5], "", set())
    assert read_cache(tmp_path / "cancelled").items() < read_cache(tmp_path / "complete").items()
    progress, messages, tracks = run_survey(drive, tmp_path / "cancelled")
    assert not messages and progress == ([5, 6] if has_poses else [4, 4, 4, 4, 5, 6])
    assert read_cache(tmp_path / "cancelled") == read_cache(tmp_path / "complete") and tracks == complete[2]


def test_survey_of_another_drive_is_replaced_and_reported(drive, tmp_path, monkeypatch):
    monkeypatch.setattr(survey_cache, "FRAMES_PER_FILE", 2)
    other_drive = Drive(
        "simulated",
        Recording(
            Path("simulated"), "simulated", [replace(frame, load=drive.frames[0].load) for frame in drive.frames]
        ),
    )  # only the clouds differ
    run_survey(drive, tmp_path, last_count=5)
    (tmp_path / JOURNAL_NAME).unlink()  # it would be rejected, because it belongs to other clouds
    progress, messages, _ = run_survey(other_drive, tmp_path, last_count=3)
    assert progress == [1, 2, 3] and "another survey (clouds " in messages
    assert read_cache(tmp_path).keys() == {"000000.npz"}
    (tmp_path / JOURNAL_NAME).unlink()
    progress, messages, _ = run_survey(drive, tmp_path)
    assert progress == [1, 2, 3, 4, 5, 6] and "surveyed again" in messages
    surveys, message = survey_cache.read(
        tmp_path / survey_cache.FOLDER, survey_cache.make_key(drive, DetectorChoice("pointpillars"))
    )
    assert surveys == [] and "weights '', not 'pointpillars'" in message


@pytest.mark.parametrize("is_restarted", [False, True])
def test_seed_corrected_before_tracking_is_tracked(drive, tmp_path, monkeypatch, is_restarted):
    monkeypatch.setattr("lidar_studio.session.NEARBY_FRAMES", 1)
    with open_session(drive, tmp_path, detector=None) as session:
        session.propose()
        monkeypatch.setattr(session, "_start", lambda *_: None)  # tracking does not start yet
        _, track = click_person(session)
        moved_box = [track.boxes[1].values[0] + 0.1, *track.boxes[1].values[1:]]
        session.execute({"do": "box", "track": track.id, "frame": 1, "box": moved_box})
        assert len(session.state.tracks[track.id].boxes) < FRAMES - 1
        if not is_restarted:
            session.propose(recompute=False)
            track = session.state.tracks[track.id]
    if is_restarted:
        with open_session(drive, tmp_path, detector=None) as new_session:
            new_session.start_proposals()
            new_session.wait()
            track = new_session.state.tracks[track.id]
    assert len(track.boxes) >= FRAMES - 1 and not track.is_partly_tracked
    assert track.boxes[1] == Box(tuple(moved_box), KEY)
    assert [f for f, b in track.boxes.items() if b.kind == KEY] == [0, 1]


def test_undoing_a_correction_keeps_all_boxes_of_the_track(session, monkeypatch):
    monkeypatch.setattr("lidar_studio.session.NEARBY_FRAMES", 1)
    session.propose()
    tasks, start = [], session._start
    monkeypatch.setattr(session, "_start", lambda *task: tasks.append(task))  # tracking does not start yet
    _, track = click_person(session)
    session.execute(
        {
            "do": "box",
            "track": track.id,
            "frame": 1,
            "box": [track.boxes[1].values[0] + 0.1, *track.boxes[1].values[1:]],
        }
    )
    ((_, run_task),) = tasks
    run_task()
    complete_track = session.state.tracks[track.id]
    assert len(complete_track.boxes) >= FRAMES - 1 and not complete_track.is_partly_tracked
    monkeypatch.setattr(session, "_start", start)
    for action in ("undo", "redo"):
        session.execute({"do": action})
        session.wait()
        track = session.state.tracks[track.id]
        assert track.boxes.keys() == complete_track.boxes.keys() and not track.is_partly_tracked


@pytest.mark.parametrize("action", ["accept", "reopen"])
def test_rejected_click_is_tracked_when_it_is_restored(session, monkeypatch, action):
    monkeypatch.setattr("lidar_studio.session.NEARBY_FRAMES", 1)
    session.propose()
    tasks, start = [], session._start
    monkeypatch.setattr(session, "_start", lambda *task: tasks.append(task))  # tracking does not start yet
    _, track = click_person(session)
    session.execute({"do": "reject", "track": track.id})
    ((_, run_task),) = tasks
    run_task()
    assert session.state.tracks[track.id].is_partly_tracked
    monkeypatch.setattr(session, "_start", start)
    session.execute({"do": action, "track": track.id})
    session.wait()
    track = session.state.tracks[track.id]
    assert len(track.boxes) >= FRAMES - 1 and not track.is_partly_tracked
    assert [track_id for _, track_id in session.state.seeds] == [track.id]


def test_first_proposals_cannot_be_undone(session):
    session.execute({"do": "check", "frame": 1})
    session.execute({"do": "undo"})
    session.propose()
    assert not session.state.undo_stack
    session.execute({"do": "redo"})
    assert session.state.checked_frames == {1}
    _, track = click_person(session)
    session.execute({"do": "undo"})
    assert track.id not in session.state.tracks and session.state.checked_frames == {1}


def test_survey_is_cached_and_repeated_if_the_cache_is_damaged(drive, tmp_path):
    with open_session(drive, tmp_path, detector=None) as session:
        session.propose()
    folder, key = tmp_path / survey_cache.FOLDER, survey_cache.make_key(drive, None)
    surveys, _ = survey_cache.read(folder, key)
    for old, new in zip(session.proposer.surveys, surveys, strict=True):
        for name in ("boxes", "images", "shapes"):
            assert np.array_equal(getattr(old, name), getattr(new, name))
        assert np.array_equal(old.detections.boxes, new.detections.boxes)
        assert old.features.keys() == new.features.keys()
        assert all(np.array_equal(old.features[n], new.features[n]) for n in old.features)
    (cache_file,) = folder.iterdir()
    content = cache_file.read_bytes()
    for damaged_content in (
        content[: len(content) // 2],
        content[:-30],
        b"",
        content[:3000] + bytes(100) + content[3100:],
    ):
        cache_file.write_bytes(damaged_content)
        surveys, message = survey_cache.read(folder, key)
        assert surveys == [] and "damaged" in message
    with open_session(drive, tmp_path, detector=None) as session:
        messages = []
        session.listeners.append(lambda event: messages.append(event.get("error", "")))
        assert session.has_proposals and session.proposer.surveys is None
        session.propose(recompute=False)
        assert any("damaged" in line for line in messages) and session.proposer.surveys is not None
    with open_session(drive, tmp_path, detector=None) as session:
        assert session.proposer.surveys is not None
        click_person(session)
        assert len(session.state.tracks) >= 1 and session.state.seeds


def test_person_clicked_before_the_survey_is_tracked_later(session):
    _, track = click_person(session)
    assert len(track.boxes) == 1
    session.propose()
    extended_track = session.state.tracks[track.id]
    assert len(extended_track.boxes) >= FRAMES - 1 and extended_track.state == "accepted"
    (key_frame,) = [f for f, b in extended_track.boxes.items() if b.kind == KEY]
    assert extended_track.boxes[key_frame] == track.boxes[key_frame]


def test_proposing_again_keeps_decisions(session):
    session.propose()
    click_person(session)
    undecided_tracks = [t for t in session.state.tracks.values() if t.state == PROPOSED]
    for track in undecided_tracks[::2]:
        session.execute({"do": "reject", "track": track.id})
    old_tracks = session.state.tracks
    session.propose()
    assert session.state.tracks == old_tracks


def test_journal_of_proposals_is_replayed_without_a_survey(session, drive, tmp_path):
    session.propose()
    click_person(session)
    state = session.state
    session.journal.close()
    journal = type(session.journal)(tmp_path, session.journal._header)
    new_session = type(session)(drive, journal, detector=None)
    assert new_session.state == state and new_session.has_proposals


def test_task_cancelled_while_waiting_ends_immediately(session):
    results, end_first = [], threading.Event()
    session._start("first", end_first.wait)
    session._start("second", lambda: results.append(session._report_progress(0)))
    session.cancel()
    end_first.set()
    session.wait()
    session._start("third", lambda: results.append(session._report_progress(0)))
    session.wait()
    assert results == [False, True]


def test_cancelled_proposals_write_nothing(session):
    session.busy = {"what": "proposing", "done": 0, "of": FRAMES}
    session.listeners.append(lambda event: session.cancel())
    session.propose()
    assert session.state == State() and session.proposer.surveys is None


def test_boxes_snap_to_ground_and_cluster(drive):
    frame = drive.frames[0]
    truth, scan = frame.truth(), drive.load_scan(0)
    is_near = np.hypot(*truth.boxes[:, :2].T) < 20  # little ground is visible farther away
    for box in truth.boxes[(truth.class_ids == 3) & is_near]:
        shifted_box = box + [0.1, -0.1, 0.3, 0, 0, 0, 0]
        ground_box, cluster_box = snap_to_ground(scan, shifted_box), snap_to_cluster(scan, shifted_box)
        assert abs(ground_box[2] - box[2]) < 0.1
        assert (ground_box[[0, 1, 3, 4, 5, 6]] == shifted_box[[0, 1, 3, 4, 5, 6]]).all()
        assert np.hypot(*(cluster_box[:2] - box[:2])) < 0.4
        assert abs(np.angle(np.exp(1j * (cluster_box[6] - shifted_box[6])))) <= np.pi / 4 + 1e-9
    with pytest.raises(InputError, match="no cluster"):
        snap_to_cluster(scan, np.array([0, 0, 50.0, 1, 1, 1, 0]))
    with pytest.raises(InputError, match="no ground"):
        snap_to_ground(scan, np.array([500.0, 0, 0, 1, 1, 1, 0]))

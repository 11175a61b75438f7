"""Proposals for a simulated drive, from seeds only."""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

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
from lidar_studio.proposals import compute_size_similarity
from lidar_studio.session import open_session
from lidar_studio.snap import snap_to_cluster, snap_to_ground
from lidar_studio.state import KEY, PROPOSED, Box, State, track_to_json

SEED, FRAMES = 127, 6  # a street with people near and far


@pytest.fixture(scope="module")
def drive(streets):
    frames = list(simulate_frames(SEED, FRAMES, frames_per_drive=20))
    return Drive("simulated", Recording(Path("simulated"), "simulated", frames, frozenset({BOXES, POSES})))


@pytest.fixture
def session(drive, tmp_path):
    """A session without labels and without a detector."""
    with open_session(drive, tmp_path, detector=None) as session:
        yield session


def person(session):
    """Return the nearest labelled person: boxes by frame, the first frame, and a measured point."""
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


def click(session):
    """Click that person; return the boxes and the track."""
    boxes, frame, xyz = person(session)
    session.do({"do": "seed", "frame": frame, "xyz": xyz, "class": "Pedestrian"})
    return boxes, session.state.tracks[session.state.seeds[-1][1]]


def test_clicked_person_is_tracked_through_the_drive(session):
    session.propose()
    assert not session.state.tracks  # without clicks nothing is similar
    boxes, track = click(session)
    assert len(boxes) >= FRAMES - 1 and boxes.keys() <= track.boxes.keys()
    near = [np.hypot(*(np.array(track.boxes[f].values)[:2] - b[:2])) for f, b in boxes.items()]
    assert max(near) < 0.5
    assert all(
        t.class_name == "Pedestrian" and t.state == PROPOSED for t in session.state.tracks.values() if t.id != track.id
    )


def boxes_of(session):
    """Return all tracks without their ids, which depend on the order of discovery."""
    return {
        (t.class_name, t.state, t.source, t.score, tuple(sorted(t.boxes.items())))
        for t in session.state.tracks.values()
    }


def test_seed_in_a_long_drive_is_tracked_nearby_first(session, drive, tmp_path, monkeypatch):
    session.propose()
    click(session)
    full = boxes_of(session)
    with open_session(drive, tmp_path / "long", detector=None) as long:
        long.propose()
        before = long.state
        monkeypatch.setattr("lidar_studio.session.NEARBY_FRAMES", 1)
        _, frame, xyz = person(long)
        answered = []
        long.listeners.append(lambda event: answered.append(event.get("tracks")))
        long.do({"do": "seed", "frame": frame, "xyz": xyz, "class": "Pedestrian"})
        long.wait()
        at_once = next(tracks for tracks in answered if tracks)
        assert {row[0] for t in at_once for row in t["boxes"]} <= {frame, frame + 1}
        assert boxes_of(long) == full
        long.do({"do": "undo"})  # both are one action
        assert long.state.tracks == before.tracks and long.state.seeds == before.seeds


def test_seed_is_applied_once_and_its_tracks_are_encoded_once(session, monkeypatch):
    session.propose()
    applied, encoded = [], []
    monkeypatch.setattr("lidar_studio.session.apply", lambda *args: applied.append(args) or apply(*args))
    monkeypatch.setattr(
        "lidar_studio.session.track_to_json", lambda track: encoded.append(track.id) or track_to_json(track)
    )
    monkeypatch.setattr("lidar_studio.state.track_from_json", None)
    click(session)
    assert len(applied) == 1
    assert encoded and len(set(encoded)) == len(encoded)


def test_clicked_car_is_a_seed_and_similar_cars_are_proposed(session):
    session.propose()
    frame = session.drive.frames[0]
    truth, scan = frame.truth(), session.drive.load_scan(0)
    cars = truth.select_class(CAR)
    inside = [scan.xyz[points_in_box(scan.xyz, b) & (scan.cluster_ids > 0)] for b in cars]
    seen = sorted(range(len(cars)), key=lambda k: -len(inside[k]))
    points = inside[seen[0]]
    middle = points[np.linalg.norm(points - cars[seen[0]][:3], axis=1).argmin()]
    session.do({"do": "seed", "frame": 0, "xyz": middle.tolist(), "class": "Car"})
    own = session.state.tracks[session.state.seeds[-1][1]]
    assert own.class_name == "Car" and math.dist(own.boxes[0].values[:2], cars[seen[0]][:2]) < 1.5
    other = [t for t in session.state.tracks.values() if t.id != own.id]
    assert other and all(t.class_name == "Car" and t.state == PROPOSED for t in other)
    scores = [t.score for t in sorted(other, key=lambda t: t.id)]
    assert scores == sorted(scores, reverse=True)
    with pytest.raises(InputError, match="no seed of a pedestrian"):
        session.proposer.compare_with_seed(session.state, own, 0)


@given(st.floats(0.5, 12), st.floats(0.3, 3), st.floats(0.5, 4), st.floats(0.2, 1.2))
def test_cluster_of_the_seed_size_is_most_similar(length, width, height, share):
    length, width = max(length, width), min(length, width)
    size = length, width, height
    same = np.array([[9.0, 0, 0, *size, 0.3]])
    assert compute_size_similarity(same, size) == pytest.approx(1.0)
    scaled = same * [1, 1, 1, share, 1, 1, 1]
    assert 0 <= compute_size_similarity(scaled, size)[0] <= 1
    larger = [compute_size_similarity(same * [1, 1, 1, s, s, s, 1], size)[0] for s in (1.0, 1.1, 1.3, 1.6)]
    assert larger == sorted(larger, reverse=True) and larger[-1] < 0.1


def run_survey(drive, folder, until=FRAMES):
    """Survey a number of frames; return the progress, the messages and the labels."""
    progress, messages = [], []
    with open_session(drive, folder, detector=None) as session:
        session.listeners.append(lambda event: messages.append(event.get("error", "")))
        run = session.proposer.run_survey

        def report(count, on_progress):
            progress.append(count)
            return on_progress(count) and not count == until < FRAMES

        session.proposer.run_survey = lambda f: run(lambda count: report(count, f))
        session.propose()
        if until == FRAMES:
            click(session)
    return progress, "".join(messages), boxes_of(session)


def read_cache(folder):
    return {p.name: p.read_bytes() for p in (folder / survey_cache.FOLDER).iterdir()}


@pytest.mark.parametrize("posed", [True, False])
def test_cancelled_survey_is_continued(drive, tmp_path, monkeypatch, posed):
    monkeypatch.setattr(survey_cache, "FRAMES_PER_FILE", 2)
    if not posed:  # then KISS-ICP estimates the poses scan by scan
        pytest.importorskip("kiss_icp")
        frames = [replace(frame, pose=lambda: None) for frame in drive.frames]
        drive = Drive("simulated", Recording(Path("simulated"), "simulated", frames))
    whole = run_survey(drive, tmp_path / "whole")
    assert whole[:2] == ([1, 2, 3, 4, 5, 6], "")
    ended = run_survey(drive, tmp_path / "ended", until=5)
    assert ended == ([1, 2, 3, 4, 5], "", set())
    assert read_cache(tmp_path / "ended").items() < read_cache(tmp_path / "whole").items()
    progress, messages, labels = run_survey(drive, tmp_path / "ended")
    assert not messages and progress == ([5, 6] if posed else [4, 4, 4, 4, 5, 6])
    assert read_cache(tmp_path / "ended") == read_cache(tmp_path / "whole") and labels == whole[2]


def test_survey_of_another_drive_is_replaced_and_reported(drive, tmp_path, monkeypatch):
    monkeypatch.setattr(survey_cache, "FRAMES_PER_FILE", 2)
    other = Drive(
        "simulated",
        Recording(
            Path("simulated"), "simulated", [replace(frame, load=drive.frames[0].load) for frame in drive.frames]
        ),
    )  # only the clouds differ
    run_survey(drive, tmp_path, until=5)
    (tmp_path / JOURNAL_NAME).unlink()  # the journal is also identified by the clouds
    progress, messages, _ = run_survey(other, tmp_path, until=3)
    assert progress == [1, 2, 3] and "another survey (clouds " in messages
    assert read_cache(tmp_path).keys() == {"000000.npz"}
    (tmp_path / JOURNAL_NAME).unlink()
    progress, messages, _ = run_survey(drive, tmp_path)
    assert progress == [1, 2, 3, 4, 5, 6] and "surveyed again" in messages
    found, why = survey_cache.read(
        tmp_path / survey_cache.FOLDER, survey_cache.make_key(drive, DetectorChoice("pointpillars"))
    )
    assert found == [] and "weights '', not 'pointpillars'" in why


def test_survey_cache_is_bounded(drive, tmp_path, monkeypatch):
    monkeypatch.setattr(survey_cache, "FRAMES_PER_FILE", 2)
    monkeypatch.setattr(survey_cache, "MAX_BYTES", 60_000)
    progress, messages, labels = run_survey(drive, tmp_path)
    assert len(progress) == FRAMES and labels and "are cached" in messages
    sizes = [len(content) for content in read_cache(tmp_path).values()]
    assert 0 < len(sizes) < FRAMES / 2 and sum(sizes) <= 60_000


@pytest.mark.parametrize("restarted", [False, True])
def test_seed_corrected_before_tracking_is_tracked(drive, tmp_path, monkeypatch, restarted):
    monkeypatch.setattr("lidar_studio.session.NEARBY_FRAMES", 1)
    with open_session(drive, tmp_path, detector=None) as session:
        session.propose()
        monkeypatch.setattr(session, "_start", lambda *_: None)  # as if there was no time
        _, track = click(session)
        moved = [track.boxes[1].values[0] + 0.1, *track.boxes[1].values[1:]]
        session.do({"do": "box", "track": track.id, "frame": 1, "box": moved})
        assert len(session.state.tracks[track.id].boxes) < FRAMES - 1
        if not restarted:
            session.propose(again=False)
            found = session.state.tracks[track.id]
    if restarted:
        with open_session(drive, tmp_path, detector=None) as again:
            again.start_proposals()
            again.wait()
            found = again.state.tracks[track.id]
    assert len(found.boxes) >= FRAMES - 1 and not found.nearby
    assert found.boxes[1] == Box(tuple(moved), KEY)
    assert [f for f, b in found.boxes.items() if b.kind == KEY] == [0, 1]


def test_undoing_a_correction_keeps_the_track(session, monkeypatch):
    monkeypatch.setattr("lidar_studio.session.NEARBY_FRAMES", 1)
    session.propose()
    begun, start = [], session._start
    monkeypatch.setattr(session, "_start", lambda *asked: begun.append(asked))  # as if it were slow
    _, track = click(session)
    session.do(
        {
            "do": "box",
            "track": track.id,
            "frame": 1,
            "box": [track.boxes[1].values[0] + 0.1, *track.boxes[1].values[1:]],
        }
    )
    ((_, work),) = begun
    work()
    extend_track = session.state.tracks[track.id]
    assert len(extend_track.boxes) >= FRAMES - 1 and not extend_track.nearby
    monkeypatch.setattr(session, "_start", start)
    for back in ("undo", "redo"):
        session.do({"do": back})
        session.wait()
        found = session.state.tracks[track.id]
        assert found.boxes.keys() == extend_track.boxes.keys() and not found.nearby


@pytest.mark.parametrize("verb", ["accept", "reopen"])
def test_click_rejected_while_tracking_is_tracked_once_restored(session, monkeypatch, verb):
    monkeypatch.setattr("lidar_studio.session.NEARBY_FRAMES", 1)
    session.propose()
    begun, start = [], session._start
    monkeypatch.setattr(session, "_start", lambda *asked: begun.append(asked))  # as if it were slow
    _, track = click(session)
    session.do({"do": "reject", "track": track.id})
    ((_, work),) = begun
    work()
    assert session.state.tracks[track.id].nearby
    monkeypatch.setattr(session, "_start", start)
    session.do({"do": verb, "track": track.id})
    session.wait()
    found = session.state.tracks[track.id]
    assert len(found.boxes) >= FRAMES - 1 and not found.nearby
    assert [number for _, number in session.state.seeds] == [track.id]


def test_first_proposals_are_not_undoable(session):
    session.do({"do": "check", "frame": 1})
    session.do({"do": "undo"})
    session.propose()
    assert not session.state.undo_stack
    session.do({"do": "redo"})
    assert session.state.checked == {1}
    _, track = click(session)
    session.do({"do": "undo"})
    assert track.id not in session.state.tracks and session.state.checked == {1}


def test_survey_survives_a_restart_and_is_redone_if_damaged(drive, tmp_path):
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
    (kept,) = folder.iterdir()
    content = kept.read_bytes()
    for damaged in (content[: len(content) // 2], content[:-30], b"", content[:3000] + bytes(100) + content[3100:]):
        kept.write_bytes(damaged)
        found, why = survey_cache.read(folder, key)
        assert found == [] and "damaged" in why
    with open_session(drive, tmp_path, detector=None) as again:
        messages = []
        again.listeners.append(lambda event: messages.append(event.get("error", "")))
        assert again.has_proposals and again.proposer.surveys is None
        again.propose(again=False)
        assert any("damaged" in line for line in messages) and again.proposer.surveys is not None
    with open_session(drive, tmp_path, detector=None) as third:
        assert third.proposer.surveys is not None
        click(third)
        assert len(third.state.tracks) >= 1 and third.state.seeds


def test_person_clicked_before_the_survey_is_tracked_after_it(session):
    _, track = click(session)
    assert len(track.boxes) == 1
    session.propose()
    extend_track = session.state.tracks[track.id]
    assert len(extend_track.boxes) >= FRAMES - 1 and extend_track.state == "accepted"
    (key,) = [f for f, b in extend_track.boxes.items() if b.kind == KEY]
    assert extend_track.boxes[key] == track.boxes[key]


def test_proposing_again_keeps_decisions(session):
    session.propose()
    click(session)
    waiting = [t for t in session.state.tracks.values() if t.state == PROPOSED]
    for track in waiting[::2]:
        session.do({"do": "reject", "track": track.id})
    before = session.state.tracks
    session.propose()
    assert session.state.tracks == before


def test_journal_of_proposals_is_replayed_without_a_survey(session, drive, tmp_path):
    session.propose()
    click(session)
    state = session.state
    session.journal.close()
    journal = type(session.journal)(tmp_path, session.journal._header)
    again = type(session)(drive, journal, detector=None)
    assert again.state == state and again.has_proposals


def test_task_cancelled_while_waiting_ends_immediately(session):
    done, go_on = [], threading.Event()
    session._start("first", go_on.wait)
    session._start("second", lambda: done.append(session._report_progress(0)))
    session.cancel()
    go_on.set()
    session.wait()
    session._start("third", lambda: done.append(session._report_progress(0)))
    session.wait()
    assert done == [False, True]


def test_cancelled_proposals_write_nothing(session):
    session.busy = {"what": "proposing", "done": 0, "of": FRAMES}
    session.listeners.append(lambda event: session.cancel())
    session.propose()
    assert session.state == State() and session.proposer.surveys is None


def test_boxes_snap_to_ground_and_cluster(drive):
    frame = drive.frames[0]
    truth, scan = frame.truth(), drive.load_scan(0)
    near = np.hypot(*truth.boxes[:, :2].T) < 20  # farther away there are few ground points
    for box in truth.boxes[(truth.class_ids == 3) & near]:
        lifted = box + [0.1, -0.1, 0.3, 0, 0, 0, 0]
        down = snap_to_ground(scan, lifted)
        assert abs(down[2] - box[2]) < 0.1 and (down[[0, 1, 3, 4, 5, 6]] == lifted[[0, 1, 3, 4, 5, 6]]).all()
        around = snap_to_cluster(scan, lifted)
        assert np.hypot(*(around[:2] - box[:2])) < 0.4
        assert abs(np.angle(np.exp(1j * (around[6] - lifted[6])))) <= np.pi / 4 + 1e-9
    with pytest.raises(InputError, match="no cluster"):
        snap_to_cluster(scan, np.array([0, 0, 50.0, 1, 1, 1, 0]))
    with pytest.raises(InputError, match="no ground"):
        snap_to_ground(scan, np.array([500.0, 0, 0, 1, 1, 1, 0]))

"""Proposals of a whole drive: what they do to labels that are there, and what a scripted annotator
makes of them. On a simulated drive, by seeds alone."""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.classes import CAR
from lidar_perception.data.frame import BOXES, POSES, Recording
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.geometry import points_in_box
from lidar_perception.simulation.recording import simulate_frames
from lidar_perception.types import InputError
from lidar_studio import survey_cache
from lidar_studio.actions import apply
from lidar_studio.annotator import Annotator, Truth, is_right
from lidar_studio.drive import Drive
from lidar_studio.journal import JOURNAL_NAME
from lidar_studio.session import open_session
from lidar_studio.size_similarity import compute_size_similarity
from lidar_studio.snap import snap_to_cluster, snap_to_ground
from lidar_studio.state import KEY, PROPOSED, Box, State, track_to_json

SEED, FRAMES = 119, 6  # a street with people near and far


@pytest.fixture(scope="module")
def drive(streets):
    frames = list(simulate_frames(SEED, FRAMES, streets_of=20))
    return Drive("simulated", Recording(Path("simulated"), "simulated", frames,
                                        frozenset({BOXES, POSES})))


@pytest.fixture
def made(drive, tmp_path):
    """Labels of which there are none yet; no detector."""
    with open_session(drive, tmp_path, detector=None) as made:
        yield made


def person(made):
    """The labelled person who is nearest: boxes by frame, and a point that was measured."""
    people = Truth(made).people.values()
    boxes = min(people, key=lambda b: np.hypot(*next(iter(b.values()))[:2]))
    frame = min(boxes)
    scan = made.drive.load_scan(frame)
    inside = scan.xyz[points_in_box(scan.xyz, boxes[frame]) & (scan.cluster_ids > 0)]
    return boxes, frame, inside[len(inside) // 2].tolist()


def click(made):
    """A seed on that person; the track."""
    boxes, frame, xyz = person(made)
    made.do({"do": "seed", "frame": frame, "xyz": xyz, "class": "Pedestrian"})
    return boxes, made.state.tracks[made.state.seeds[-1][1]]


def test_a_clicked_person_is_followed_through_the_drive(made):
    made.propose(in_process=True)
    assert not made.state.tracks  # nothing is like nobody
    boxes, track = click(made)
    assert len(boxes) >= FRAMES - 1 and boxes.keys() <= track.boxes.keys()
    near = [np.hypot(*(np.array(track.boxes[f].values)[:2] - b[:2])) for f, b in boxes.items()]
    assert max(near) < 0.5
    assert all(t.class_name == "Pedestrian" and t.state == PROPOSED
               for t in made.state.tracks.values() if t.id != track.id)


def boxes_of(made):
    """Of all tracks, with what they are but for their ids, which say when they were found."""
    return {(t.class_name, t.state, t.source, t.score, tuple(sorted(t.boxes.items())))
            for t in made.state.tracks.values()}


def test_a_seed_in_a_long_drive_is_answered_at_once_and_in_the_end_in_full(
        made, drive, tmp_path, monkeypatch):
    made.propose(in_process=True)
    click(made)
    full = boxes_of(made)
    with open_session(drive, tmp_path / "long", detector=None) as long:
        long.propose(in_process=True)
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


def test_seed_is_applied_once_and_its_tracks_are_encoded_once(made, monkeypatch):
    made.propose(in_process=True)
    applied, encoded = [], []
    monkeypatch.setattr("lidar_studio.session.apply",
                        lambda *args: applied.append(args) or apply(*args))
    monkeypatch.setattr("lidar_studio.session.track_to_json",
                        lambda track: encoded.append(track.id) or track_to_json(track))
    monkeypatch.setattr("lidar_studio.state.track_from_json", None)
    click(made)
    assert len(applied) == 1
    assert encoded and len(set(encoded)) == len(encoded)


def test_a_car_that_is_clicked_is_a_seed_too_and_others_like_it_are_proposed(made):
    made.propose(in_process=True)
    frame = made.drive.frames[0]
    truth, scan = frame.truth(), made.drive.load_scan(0)
    cars = truth.of_class(CAR)
    inside = [scan.xyz[points_in_box(scan.xyz, b) & (scan.cluster_ids > 0)] for b in cars]
    seen = sorted(range(len(cars)), key=lambda k: -len(inside[k]))
    points = inside[seen[0]]
    middle = points[np.linalg.norm(points - cars[seen[0]][:3], axis=1).argmin()]
    made.do({"do": "seed", "frame": 0, "xyz": middle.tolist(), "class": "Car"})
    own = made.state.tracks[made.state.seeds[-1][1]]
    assert own.class_name == "Car" and math.dist(own.boxes[0].values[:2], cars[seen[0]][:2]) < 1.5
    other = [t for t in made.state.tracks.values() if t.id != own.id]
    assert other and all(t.class_name == "Car" and t.state == PROPOSED for t in other)
    scores = [t.score for t in sorted(other, key=lambda t: t.id)]
    assert scores == sorted(scores, reverse=True)
    silhouettes = made.proposer.silhouettes(made.state, own, 0)
    assert silhouettes["similarity"] > 0.9 and "1" in silhouettes["seed"]["bits"]


@given(st.floats(0.5, 12), st.floats(0.3, 3), st.floats(0.5, 4), st.floats(0.2, 1.2))
def test_what_is_as_large_as_the_seed_is_most_alike(length, width, height, share):
    length, width = max(length, width), min(length, width)
    size = length, width, height
    same = np.array([[9.0, 0, 0, *size, 0.3]])
    assert compute_size_similarity(same, size) == pytest.approx(1.0)
    scaled = same * [1, 1, 1, share, 1, 1, 1]
    assert 0 <= compute_size_similarity(scaled, size)[0] <= 1
    larger = [compute_size_similarity(same * [1, 1, 1, s, s, s, 1], size)[0]
              for s in (1.0, 1.1, 1.3, 1.6)]
    assert larger == sorted(larger, reverse=True) and larger[-1] < 0.1


def frames_looked_at(drive, folder, until=FRAMES):
    """Of a session that is ended once so many frames are looked at; what it says, its labels."""
    looked_at, said = [], []
    with open_session(drive, folder, detector=None) as made:
        made.listeners.append(lambda event: said.append(event.get("error", "")))

        def told(count):
            looked_at.append(count)
            if count == until < FRAMES:
                made.cancel()
        made.propose(in_process=True, on_progress=told)
        if until == FRAMES:
            click(made)
    return looked_at, "".join(said), boxes_of(made)


def kept_in(folder):
    return {p.name: p.read_bytes() for p in (folder / survey_cache.FOLDER).iterdir()}


@pytest.mark.parametrize("posed", [True, False])
def test_a_survey_that_was_ended_goes_on_where_it_was(drive, tmp_path, monkeypatch, posed):
    monkeypatch.setattr(survey_cache, "FRAMES_PER_FILE", 2)
    if not posed:  # then KISS-ICP finds the poses, scan after scan
        pytest.importorskip("kiss_icp")
        frames = [replace(frame, pose=lambda: None) for frame in drive.frames]
        drive = Drive("simulated", Recording(Path("simulated"), "simulated", frames))
    whole = frames_looked_at(drive, tmp_path / "whole")
    assert whole[:2] == ([1, 2, 3, 4, 5, 6], "")
    ended = frames_looked_at(drive, tmp_path / "ended", until=5)
    assert ended == ([1, 2, 3, 4, 5], "", set())
    assert kept_in(tmp_path / "ended").items() < kept_in(tmp_path / "whole").items()
    looked_at, said, labels = frames_looked_at(drive, tmp_path / "ended")
    assert not said and looked_at == ([5, 6] if posed else [4, 4, 4, 4, 5, 6])
    assert kept_in(tmp_path / "ended") == kept_in(tmp_path / "whole") and labels == whole[2]


def test_a_survey_of_something_else_is_begun_anew_and_that_is_said(drive, tmp_path, monkeypatch):
    monkeypatch.setattr(survey_cache, "FRAMES_PER_FILE", 2)
    other = Drive("simulated", Recording(Path("simulated"), "simulated", [
        replace(frame, load=drive.frames[0].load) for frame in drive.frames]))  # other clouds only
    frames_looked_at(drive, tmp_path, until=5)
    (tmp_path / JOURNAL_NAME).unlink()  # the journal is of the clouds, too
    looked_at, said, _ = frames_looked_at(other, tmp_path, until=3)
    assert looked_at == [1, 2, 3] and "another survey (clouds " in said
    assert kept_in(tmp_path).keys() == {"000000.npz"}
    (tmp_path / JOURNAL_NAME).unlink()
    looked_at, said, _ = frames_looked_at(drive, tmp_path)
    assert looked_at == [1, 2, 3, 4, 5, 6] and "surveyed again" in said
    found, why = survey_cache.read(tmp_path / survey_cache.FOLDER,
                                   survey_cache.make_key(drive, DetectorChoice("pointpillars")))
    assert found == [] and "weights '', not 'pointpillars'" in why


def test_a_survey_takes_no_more_room_than_it_may(drive, tmp_path, monkeypatch):
    monkeypatch.setattr(survey_cache, "FRAMES_PER_FILE", 2)
    monkeypatch.setattr(survey_cache, "MAX_BYTES", 60_000)
    looked_at, said, labels = frames_looked_at(drive, tmp_path)
    assert len(looked_at) == FRAMES and labels and "are cached" in said
    sizes = [len(content) for content in kept_in(tmp_path).values()]
    assert 0 < len(sizes) < FRAMES / 2 and sum(sizes) <= 60_000


@pytest.mark.parametrize("restarted", [False, True])
def test_a_seed_that_is_corrected_before_it_was_followed_is_followed_all_the_same(
        drive, tmp_path, monkeypatch, restarted):
    """Also if the server was killed meanwhile, by the next one."""
    monkeypatch.setattr("lidar_studio.session.NEARBY_FRAMES", 1)
    with open_session(drive, tmp_path, detector=None) as made:
        made.propose(in_process=True)
        monkeypatch.setattr(made, "_start", lambda *_: None)  # it had no time
        _, track = click(made)
        moved = [track.boxes[1].values[0] + 0.1, *track.boxes[1].values[1:]]
        made.do({"do": "box", "track": track.id, "frame": 1, "box": moved})
        assert len(made.state.tracks[track.id].boxes) < FRAMES - 1
        if not restarted:
            made.propose(in_process=True, again=False)
            found = made.state.tracks[track.id]
    if restarted:
        with open_session(drive, tmp_path, detector=None) as again:
            again.start_proposals()
            again.wait()
            found = again.state.tracks[track.id]
    assert len(found.boxes) >= FRAMES - 1 and not found.nearby
    assert found.boxes[1] == Box(tuple(moved), KEY)
    assert [f for f, b in found.boxes.items() if b.kind == KEY] == [0, 1]


def test_a_correction_that_is_undone_while_a_click_was_followed_leaves_it_followed(
        made, monkeypatch):
    monkeypatch.setattr("lidar_studio.session.NEARBY_FRAMES", 1)
    made.propose(in_process=True)
    begun, start = [], made._start
    monkeypatch.setattr(made, "_start", lambda *asked: begun.append(asked))  # slowly
    _, track = click(made)
    made.do({"do": "box", "track": track.id, "frame": 1, "box": [
        track.boxes[1].values[0] + 0.1, *track.boxes[1].values[1:]]})
    (_, work), = begun
    work()
    extend_track = made.state.tracks[track.id]
    assert len(extend_track.boxes) >= FRAMES - 1 and not extend_track.nearby
    monkeypatch.setattr(made, "_start", start)
    for back in ("undo", "redo"):
        made.do({"do": back})
        made.wait()
        found = made.state.tracks[track.id]
        assert found.boxes.keys() == extend_track.boxes.keys() and not found.nearby


@pytest.mark.parametrize("verb", ["accept", "reopen"])
def test_a_click_that_is_rejected_while_it_is_followed_is_followed_once_that_is_taken_back(
        made, monkeypatch, verb):
    monkeypatch.setattr("lidar_studio.session.NEARBY_FRAMES", 1)
    made.propose(in_process=True)
    begun, start = [], made._start
    monkeypatch.setattr(made, "_start", lambda *asked: begun.append(asked))  # slowly
    _, track = click(made)
    made.do({"do": "reject", "track": track.id})
    (_, work), = begun
    work()
    assert made.state.tracks[track.id].nearby
    monkeypatch.setattr(made, "_start", start)
    made.do({"do": verb, "track": track.id})
    made.wait()
    found = made.state.tracks[track.id]
    assert len(found.boxes) >= FRAMES - 1 and not found.nearby
    assert [number for _, number in made.state.seeds] == [track.id]


def test_what_was_only_looked_at_by_the_server_is_nobodys_to_undo(made):
    """The first proposals come when they come: they take nothing from redo, nor a seed with them
    when they are undone."""
    made.do({"do": "check", "frame": 1})
    made.do({"do": "undo"})
    made.propose(in_process=True)
    assert not made.state.undo_stack
    made.do({"do": "redo"})
    assert made.state.checked == {1}
    _, track = click(made)
    made.do({"do": "undo"})
    assert track.id not in made.state.tracks and made.state.checked == {1}


def test_the_survey_is_kept_over_a_restart_and_made_again_where_it_is_damaged(drive, tmp_path):
    with open_session(drive, tmp_path, detector=None) as made:
        made.propose(in_process=True)
    folder, key = tmp_path / survey_cache.FOLDER, survey_cache.make_key(drive, None)
    surveys, _ = survey_cache.read(folder, key)
    for old, new in zip(made.proposer.surveys, surveys, strict=True):
        for name in ("boxes", "images", "shapes"):
            assert np.array_equal(getattr(old, name), getattr(new, name))
        assert np.array_equal(old.detections.boxes, new.detections.boxes)
        assert old.features.keys() == new.features.keys()
        assert all(np.array_equal(old.features[n], new.features[n]) for n in old.features)
    kept, = folder.iterdir()
    content = kept.read_bytes()
    for damaged in (content[:len(content) // 2], content[:-30], b"",
                    content[:3000] + bytes(100) + content[3100:]):
        kept.write_bytes(damaged)
        found, why = survey_cache.read(folder, key)
        assert found == [] and "damaged" in why
    with open_session(drive, tmp_path, detector=None) as again:
        said = []
        again.listeners.append(lambda event: said.append(event.get("error", "")))
        assert again.has_proposals and again.proposer.surveys is None
        again.propose(in_process=True, again=False)
        assert any("damaged" in line for line in said) and again.proposer.surveys is not None
    with open_session(drive, tmp_path, detector=None) as third:
        assert third.proposer.surveys is not None
        click(third)
        assert len(third.state.tracks) >= 1 and third.state.seeds


def test_a_person_who_was_clicked_before_the_drive_was_looked_at_is_followed_then(made):
    _, track = click(made)
    assert len(track.boxes) == 1
    made.propose(in_process=True)
    extend_track = made.state.tracks[track.id]
    assert len(extend_track.boxes) >= FRAMES - 1 and extend_track.state == "accepted"
    key, = [f for f, b in extend_track.boxes.items() if b.kind == KEY]
    assert extend_track.boxes[key] == track.boxes[key]


def test_proposing_again_changes_nothing_that_was_decided(made):
    made.propose(in_process=True)
    click(made)
    waiting = [t for t in made.state.tracks.values() if t.state == PROPOSED]
    for track in waiting[::2]:
        made.do({"do": "reject", "track": track.id})
    before = made.state.tracks
    made.propose(in_process=True)
    assert made.state.tracks == before


def test_the_journal_of_proposals_is_replayed_without_looking_at_the_drive(made, drive, tmp_path):
    made.propose(in_process=True)
    click(made)
    state = made.state
    made.journal.close()
    again = type(made)(drive, type(made.journal)(tmp_path, made.journal._header), detector=None)
    assert again.state == state and again.has_proposals


def test_the_annotator_ends_with_every_person_right_and_less_work(made):
    made.propose(in_process=True)
    done = Annotator(made).run()
    truth = Truth(made)
    assert done["people"] == len(truth.people) > 0
    accepted = [t for t in made.state.tracks.values() if t.state == "accepted"]
    for boxes in truth.people.values():
        for f, true in boxes.items():
            assert any(f in t.boxes and is_right(np.array(t.boxes[f].values), true)
                       for t in accepted)
    assert done["actions"] == sum(done["kinds"].values()) < done["by_hand"]


def test_what_is_cancelled_while_it_waits_for_what_went_on_before_ends_at_once(made):
    done, go_on = [], threading.Event()
    made._start("first", go_on.wait)
    made._start("second", lambda: done.append(made._report_progress(0)))
    made.cancel()
    go_on.set()
    made.wait()
    made._start("third", lambda: done.append(made._report_progress(0)))
    made.wait()
    assert done == [False, True]


def test_proposals_that_are_cancelled_write_nothing(made):
    made.busy = {"what": "proposing", "done": 0, "of": FRAMES}
    made.listeners.append(lambda event: made.cancel())
    made.propose(in_process=True)
    assert made.state == State() and made.proposer.surveys is None


def test_boxes_snap_to_what_is_there(drive):
    frame = drive.frames[0]
    truth, scan = frame.truth(), drive.load_scan(0)
    near = np.hypot(*truth.boxes[:, :2].T) < 20  # farther away little ground is seen
    for box in truth.boxes[(truth.class_ids == 3) & near]:
        lifted = box + [0.1, -0.1, 0.3, 0, 0, 0, 0]
        down = snap_to_ground(scan, lifted)
        assert abs(down[2] - box[2]) < 0.1 and (down[[0, 1, 3, 4, 5, 6]]
                                                == lifted[[0, 1, 3, 4, 5, 6]]).all()
        around = snap_to_cluster(scan, lifted)
        assert np.hypot(*(around[:2] - box[:2])) < 0.4
        assert abs(np.angle(np.exp(1j * (around[6] - lifted[6])))) <= np.pi / 4 + 1e-9
    with pytest.raises(InputError, match="no cluster"):
        snap_to_cluster(scan, np.array([0, 0, 50.0, 1, 1, 1, 0]))
    with pytest.raises(InputError, match="no ground"):
        snap_to_ground(scan, np.array([500.0, 0, 0, 1, 1, 1, 0]))

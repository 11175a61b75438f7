"""Proposals of a whole drive: what they do to labels that are there, and what a scripted annotator
makes of them. On a simulated drive, by seeds alone."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from lidar_perception.data.frame import BOXES, POSES, Recording
from lidar_perception.geometry import points_in_box
from lidar_perception.labeling.annotator import Annotator, Truth, is_right
from lidar_perception.labeling.drive import Clouds, Drive, Scan, one_drive
from lidar_perception.labeling.interpolation import Motion
from lidar_perception.labeling.proposing import merged
from lidar_perception.labeling.session import session
from lidar_perception.labeling.snap import headed, to_cluster, to_ground, to_size
from lidar_perception.labeling.state import KEY, PROPOSED, Box, State, Track
from lidar_perception.simulation.to_bag import simulated_scans
from lidar_perception.types import InputError

SEED, FRAMES = 119, 6  # a street with people near and far
MOTION = Motion.of(np.arange(8) * 10**8)


@pytest.fixture(scope="module")
def drive(streets):
    frames = list(simulated_scans(SEED, FRAMES, streets_of=20))
    return Drive("simulated", Recording(Path("simulated"), "simulated", frames,
                                        frozenset({BOXES, POSES})))


@pytest.fixture
def made(drive, tmp_path):
    """Labels of which there are none yet; no detector."""
    with session(drive, tmp_path, weights="") as made:
        yield made


def person(made):
    """The labelled person who is nearest: boxes by frame, and a point that was measured."""
    people = Truth(made).people.values()
    boxes = min(people, key=lambda b: np.hypot(*next(iter(b.values()))[:2]))
    frame = min(boxes)
    scan = made.drive.clouds(frame)
    inside = scan.xyz[points_in_box(scan.xyz, boxes[frame]) & (scan.cluster_ids > 0)]
    return boxes, frame, inside[len(inside) // 2].tolist()


def click(made):
    """A seed on that person; the track."""
    boxes, frame, xyz = person(made)
    made.do({"do": "seed", "frame": frame, "xyz": xyz, "class": "Pedestrian"})
    return boxes, made.state.tracks[made.state.seeds[-1][1]]


def test_a_clicked_person_is_followed_through_the_drive(made):
    made.propose(here=True)
    assert not made.state.tracks  # nothing is like nobody
    boxes, track = click(made)
    assert len(boxes) >= FRAMES - 1 and boxes.keys() <= track.boxes.keys()
    near = [np.hypot(*(np.array(track.boxes[f].values)[:2] - b[:2])) for f, b in boxes.items()]
    assert max(near) < 0.5
    assert all(t.class_name == "Pedestrian" and t.state == PROPOSED
               for t in made.state.tracks.values() if t.id != track.id)


def test_a_person_who_was_clicked_before_the_drive_was_looked_at_is_followed_then(made):
    _, track = click(made)
    assert len(track.boxes) == 1
    made.propose(here=True)
    followed = made.state.tracks[track.id]
    assert len(followed.boxes) >= FRAMES - 1 and followed.state == "accepted"
    key, = [f for f, b in followed.boxes.items() if b.kind == KEY]
    assert followed.boxes[key] == track.boxes[key]


def test_proposing_again_changes_nothing_that_was_decided(made):
    made.propose(here=True)
    click(made)
    waiting = [t for t in made.state.tracks.values() if t.state == PROPOSED]
    for track in waiting[::2]:
        made.do({"do": "reject", "track": track.id})
    before = made.state.tracks
    made.propose(here=True)
    assert made.state.tracks == before


def test_the_journal_of_proposals_is_replayed_without_looking_at_the_drive(made, drive, tmp_path):
    made.propose(here=True)
    click(made)
    state = made.state
    made.journal.close()
    again = type(made)(drive, type(made.journal)(tmp_path, made.journal._head), weights="")
    assert again.state == state and again.was_proposed


def test_the_annotator_ends_with_every_person_right_and_less_work(made):
    made.propose(here=True)
    done = Annotator(made).work()
    truth = Truth(made)
    assert done["people"] == len(truth.people) > 0
    accepted = [t for t in made.state.tracks.values() if t.state == "accepted"]
    for boxes in truth.people.values():
        for f, true in boxes.items():
            assert any(f in t.boxes and is_right(np.array(t.boxes[f].values), true)
                       for t in accepted)
    assert done["actions"] == sum(done["kinds"].values()) < done["by_hand"]


def test_proposals_that_are_cancelled_write_nothing(made):
    made.busy = {"what": "proposing", "done": 0, "of": FRAMES}
    made.listeners.append(lambda event: made.cancel())
    made.propose(here=True)
    assert made.state == State() and made.proposer.looks is None


def straight(x, y, frames, **more):
    """A track that stands."""
    boxes = {f: Box((x, y, -1.0, 0.8, 0.6, 1.7, 0.0), PROPOSED) for f in frames}
    return Track(0, "Pedestrian", boxes=boxes, **{"source": "fused", **more})


def with_id(track, number, **more):
    """The same under its number."""
    from dataclasses import replace
    return replace(track, id=number, **more)


def test_proposals_keep_ids_and_take_nothing_from_a_person():
    old = {1: with_id(straight(5, 0, range(8)), 1),
           2: with_id(straight(9, 0, range(8)), 2, state="rejected"),
           3: with_id(straight(20, 0, range(8)), 3),
           4: with_id(straight(30, 0, [2]), 4, state="accepted", source="click"),
           5: with_id(straight(40, 0, range(8)), 5, source="imported")}
    state = State(old, next_id=6)
    new = [straight(5.1, 0, range(8)), straight(9.1, 0, range(8)), straight(30.1, 0, range(6)),
           straight(50, 0, range(8)), straight(40, 0.1, range(8))]
    tracks, removed = merged(state, new, MOTION)
    found = {t.id: t for t in tracks}
    assert removed == [3] and found.keys() == {1, 4, 6}
    assert found[1].boxes == new[0].boxes and found[6].boxes == new[3].boxes
    assert found[4].state == "accepted" and found[4].boxes.keys() == set(range(6))
    again = State({**{n: t for n, t in old.items() if n != 3}, **found}, next_id=7)
    assert merged(again, new, MOTION) == ([], [])


def test_clouds_keep_to_their_bound_and_are_made_once():
    made = []

    def make(i):
        made.append(i)
        return Scan(np.zeros((1000, 3), np.float32), np.zeros(1000, np.uint8),
                    np.zeros(1000, bool), np.zeros(1000, np.int32))
    clouds = Clouds(make, limit=5 * make(0).size)
    made.clear()
    threads = [threading.Thread(target=clouds, args=(3,)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert made == [3]
    for i in range(1000):
        clouds(i)
        assert sum(s.size for s in clouds._kept.values()) == clouds._size <= 5 * make(0).size
    assert len(clouds._making) <= 6


def test_a_recording_of_several_drives_wants_one_named():
    frames = [*simulated_scans(SEED, 2, streets_of=1)]
    recording = Recording(Path("two"), "simulated", frames)
    with pytest.raises(InputError, match="--sequence"):
        one_drive(recording)
    assert [f.sequence for f in one_drive(recording, "0001").frames] == ["0001"]
    with pytest.raises(InputError, match="no drive 7"):
        one_drive(recording, "7")


def test_boxes_snap_to_what_is_there(drive):
    frame = drive.frames[0]
    truth, scan = frame.truth(), drive.clouds(0)
    near = np.hypot(*truth.boxes[:, :2].T) < 20  # farther away little ground is seen
    for box in truth.boxes[(truth.class_ids == 3) & near]:
        lifted = box + [0.1, -0.1, 0.3, 0, 0, 0, 0]
        down = to_ground(scan, lifted)
        assert abs(down[2] - box[2]) < 0.1 and (down[[0, 1, 3, 4, 5, 6]]
                                               == lifted[[0, 1, 3, 4, 5, 6]]).all()
        around = to_cluster(scan, lifted)
        assert np.hypot(*(around[:2] - box[:2])) < 0.4
        assert abs(np.angle(np.exp(1j * (around[6] - lifted[6])))) <= np.pi / 4 + 1e-9
    with pytest.raises(InputError, match="no cluster"):
        to_cluster(scan, np.array([0, 0, 50.0, 1, 1, 1, 0]))
    with pytest.raises(InputError, match="no ground"):
        to_ground(scan, np.array([500.0, 0, 0, 1, 1, 1, 0]))


def test_another_size_leaves_the_corner_that_is_seen():
    from lidar_perception.geometry import box_corners
    rng = np.random.default_rng(0)
    for _ in range(50):
        box = np.array([*rng.uniform(8, 20, 2) * rng.choice([-1, 1], 2), 0, *rng.uniform(1, 4, 3),
                        rng.uniform(-3, 3)])
        other = to_size(box, rng.uniform(1, 4, 3))
        corners, after = (box_corners(b[None])[0][:, :2] for b in (box, other))
        nearest = int(np.hypot(*corners.T).argmin())
        seen = np.array([np.cos(box[6]), np.sin(box[6])]) @ -box[:2]
        if abs(seen) > box[3] / 2 and abs(np.array([-np.sin(box[6]), np.cos(box[6])])
                                         @ -box[:2]) > box[4] / 2:
            assert np.allclose(corners[nearest], after[nearest])
        assert other[2] - other[5] / 2 == pytest.approx(box[2] - box[5] / 2)
        assert to_size(other, box[3:6]) == pytest.approx(box) or abs(seen) <= 4


def test_a_box_has_four_ways_to_say_it():
    box = np.array([1.0, 2, 3, 4, 2, 1, 0.3])
    for turn in range(-4, 5):
        again = headed(headed(box, 0.3 + turn * np.pi / 2), 0.35)
        assert again == pytest.approx(box)

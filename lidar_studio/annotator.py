"""A scripted annotator who knows the truth and does what a person would on the page, counted: how
many actions it takes until every pedestrian of a drive is right.

Counted are clicks, keys and drags that change labels or choose among them. Looking at frames, which
labelling by hand needs as well, is not.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lidar_perception.geometry import bev_iou, points_in_box
from lidar_perception.types import CLASSES, PEDESTRIAN, InputError
from lidar_studio.proposing import REACH
from lidar_studio.session import Session
from lidar_studio.state import ACCEPTED, PROPOSED, Track, next_uncertain
from lidar_studio.survey import Look

Array = np.ndarray[Any, Any]
OVERLAP, CENTRE = 0.7, 0.2  # a box is right from this overlap seen from above, or metres, on
PLACE, ADJUST = 1, 3        # actions of a box made by hand, and of one put right in all
PERSON = CLASSES[PEDESTRIAN]
REPORTED = 0.4              # score of a detection that is shown where there are no tracks
ROUNDS = 1000               # more actions than this at one person are a fault of ours


class Truth:
    """The labelled pedestrians of a drive, those that its camera sees where it has one: by track
    id, by frame, a box (7,)."""

    def __init__(self, session: Session) -> None:
        self.people: dict[int, dict[int, Array]] = {}
        self._cameras = [frame.camera() for frame in session.drive.frames]
        for f, frame in enumerate(session.drive.frames):
            truth = frame.truth()
            for k, box in enumerate([] if truth is None else truth.boxes):
                if truth is not None and truth.class_ids[k] == PEDESTRIAN:
                    track = truth.extras[k].get("track_id", -1 - f * 1000 - k)
                    self.people.setdefault(track, {})[f] = box

    @property
    def boxes(self) -> int:
        """How many there are."""
        return sum(map(len, self.people.values()))

    def seen(self, frame: int, box: Array) -> bool:
        """Whether a box (7,) lies where objects are labelled."""
        camera = self._cameras[frame]
        return camera is None or bool(camera.in_view(box[None, :3])[0])

    def person(self, track: Track) -> int | None:
        """Whom most of a track's boxes are, or None."""
        votes: Counter[int] = Counter()
        for f, box in track.boxes.items():
            centre = np.array(box.values)
            near = [(distance(b[f], centre), n) for n, b in self.people.items() if f in b]
            if near and min(near)[0] <= REACH:
                votes[min(near)[1]] += 1
        labelled = sum(self.seen(f, np.array(b.values)) for f, b in track.boxes.items())
        number, count = next(iter(votes.most_common(1)), (-1, 0))
        return number if count > 0 and 2 * count >= labelled else None


def distance(one: Array, other: Array) -> float:
    """Metres between the centres of two boxes (7,), seen from above."""
    return float(np.hypot(*(one[:2] - other[:2])))


def is_right(box: Array, true: Array) -> bool:
    """Whether a box (7,) is good enough."""
    return distance(box, true) <= CENTRE or bool(bev_iou(box[None], true[None])[0, 0] >= OVERLAP)


class Annotator:
    """Labels the pedestrians of a session whose drive was surveyed. counts: actions by kind."""

    def __init__(self, session: Session) -> None:
        self.session, self.truth = session, Truth(session)
        self.counts: Counter[str] = Counter()
        self.looked_at: set[int] = set()  # ids of proposals
        self._own: dict[int, int] = {}  # person -> id of the track

    def work(self) -> dict[str, Any]:
        """Label until every pedestrian is right; what it took. InputError where that fails."""
        self._decide()
        for number in sorted(self.truth.people):
            self._find(number)
            self._decide()
        for number in sorted(self.truth.people):
            self._finish(number)
        self._reject_rest()
        self._check()
        return {"people": len(self.truth.people), "boxes": self.truth.boxes,
                "looked_at": len(self.looked_at), "actions": self.actions,
                "kinds": dict(sorted(self.counts.items())),
                "corrections_in_full": self.actions + (ADJUST - 1) * self.counts["drag"],
                "by_hand": (PLACE + ADJUST) * self.truth.boxes,
                "without_tracks": without_tracks(self.session.proposer.looks or [], self.truth)}

    @property
    def actions(self) -> int:
        """So far."""
        return sum(self.counts.values())

    def _do(self, kind: str, **action: Any) -> None:
        self.session.do(action, "annotator")
        self.session.wait()  # a seed is followed
        self.counts[kind] += 1

    def _decide(self) -> None:
        """Accept every proposed pedestrian who is one, as the frames are looked through: a key
        each, while the pointer is on the box. A second track of a person is joined to the first."""
        while (track := next_uncertain(self.session.state, among=self._is_new)) is not None:
            person = self.truth.person(track)
            self.looked_at.add(track.id)
            if person is None:
                continue
            self._do("key: accept", do="accept", track=track.id)
            if self._own.setdefault(person, track.id) != track.id:
                self.counts["click: select the other one"] += 1
                self._do("key: merge", do="merge", tracks=[self._own[person], track.id])

    def _is_new(self, track: Track) -> bool:
        """Whether a track is to be looked at: called a pedestrian, some of it where pedestrians are
        labelled, and not looked at before."""
        return (track.class_name == PERSON and track.id not in self.looked_at and any(
            self.truth.seen(f, np.array(b.values)) for f, b in track.boxes.items()))

    def _reject_rest(self) -> None:
        """What was not accepted, at once: only pedestrians are listed, and the rest of them is
        rejected."""
        if any(t.state == PROPOSED and t.id in self.looked_at
               for t in self.session.state.tracks.values()):
            self.counts["click: only pedestrians"] += 1
            self._do("key: reject the rest", do="reject_rest", **{"class": PERSON})

    def _track_of(self, person: int) -> Track:
        return self.session.state.tracks[self._own[person]]

    def _find(self, person: int) -> None:
        """Where a person has no track: one of another class gets the right one, else click where
        the person is nearest, or place a box there."""
        if person in self._own:
            return
        boxes = self.truth.people[person]
        for track in self.session.state.tracks.values():
            if track.state == PROPOSED and self.truth.person(track) == person:
                self._own[person] = track.id
                self.counts["click: select"] += 1
                self._do("key: class", do="class", track=track.id, **{"class": PERSON})
                self._do("key: accept", do="accept", track=track.id)
                return
        frame = min(boxes, key=lambda f: float(np.hypot(*boxes[f][:2])))
        try:
            xyz = self._point(frame, boxes[frame])
            self._do("click: seed", do="seed", frame=frame, xyz=xyz, **{"class": PERSON})
            self._own[person] = self.session.state.seeds[-1][1]
        except InputError:  # no cluster
            self._own[person] = self.session.state.next_id
            self._do("place", do="add", frame=frame, box=boxes[frame].tolist(),
                     **{"class": PERSON})
            self.counts["adjust"] += ADJUST

    def _point(self, frame: int, box: Array) -> list[float]:
        """A point of the person that has a cluster, near the middle."""
        scan = self.session.drive.clouds(frame)
        inside = np.flatnonzero(points_in_box(scan.xyz, box, 0.1) & (scan.cluster_ids > 0))
        if len(inside) == 0:
            raise InputError("there is no cluster to click")
        apart = np.linalg.norm(scan.xyz[inside] - box[:3], axis=1)
        return [float(v) for v in scan.xyz[inside[apart.argmin()]]]

    def _finish(self, person: int) -> None:
        """Take away what is too much, then put right the worst box, until none is wrong."""
        boxes = self.truth.people[person]
        for _ in range(ROUNDS):
            self._trim(person)
            track = self._track_of(person)
            wrong = {f: distance(b, np.array(track.boxes[f].values)) if f in track.boxes else np.inf
                     for f, b in boxes.items()
                     if f not in track.boxes or not is_right(np.array(track.boxes[f].values), b)}
            if not wrong:
                return
            ranks = {f: (_rank(track, f, error), -f) for f, error in wrong.items()}
            self._correct(person, track, max(wrong, key=ranks.__getitem__))
        raise InputError(f"person {person} did not come right; the annotator goes in circles")

    def _correct(self, person: int, track: Track, frame: int) -> None:
        """One drag: to its place; the size and the heading stay."""
        true = self.truth.people[person][frame]
        if frame not in track.boxes:
            nearest = min(track.boxes, key=lambda f: abs(f - frame))
            self._do("key: copy", do="copy", track=track.id, **{"from": nearest, "to": frame})
            track = self._track_of(person)
            if is_right(np.array(track.boxes[frame].values), true):
                return
        box = np.array(track.boxes[frame].values)
        box[:2] = true[:2]
        self._do("drag", do="box", track=track.id, frame=frame, box=box.tolist())

    def _trim(self, person: int) -> None:
        """Let it begin and end where the person does; in between, remove boxes one by one."""
        boxes = self.truth.people[person]
        for late in (True, False):
            track = self._track_of(person)
            extra = sorted(f for f, b in track.boxes.items() if f not in boxes
                           and self.truth.seen(f, np.array(b.values)))
            outside = [f for f in extra if (f > max(boxes) if late else f < min(boxes))]
            if not outside:
                continue
            self._do("key: ends here" if late else "key: begins here", do="trim", track=track.id,
                     frame=max(boxes) if late else min(boxes), side="after" if late else "before")
        track = self._track_of(person)
        for f in sorted(track.boxes):
            if f not in boxes and self.truth.seen(f, np.array(track.boxes[f].values)):
                self._do("key: remove", do="remove_box", track=track.id, frame=f)

    def _check(self) -> None:
        """That it is true. InputError where a pedestrian is not right, or one is labelled twice or
        where there is none."""
        person_of = {track: person for person, track in self._own.items()}
        for track in self.session.state.tracks.values():
            if track.state != ACCEPTED or track.class_name != PERSON:
                continue
            boxes = self.truth.people[person_of[track.id]] if track.id in person_of else {}
            for f, box in track.boxes.items():
                values = np.array(box.values)
                if f in boxes and not is_right(values, boxes[f]):
                    raise InputError(f"frame {f}: track {track.id} is not right")
                if f not in boxes and self.truth.seen(f, values):
                    raise InputError(f"frame {f}: track {track.id} labels nobody")
            if missing := boxes.keys() - track.boxes.keys():
                raise InputError(f"track {track.id} has no box in frame {min(missing)}")
        if len(person_of) < len(self.truth.people):
            raise InputError("a person has no track of its own")


def _rank(track: Track, frame: int, error: float) -> float:
    """Which box to put right first: where there is none, the one farthest from the others, as
    what lies between follows; then the one that is farthest off."""
    return error if np.isfinite(error) else 1e6 + min(abs(frame - f) for f in track.boxes)


def without_tracks(looks: Sequence[Look], truth: Truth) -> int:
    """Actions where a person gets the detections of each frame by themselves: a key for each, a
    drag for those that are not quite right, and a box by hand for each pedestrian without one."""
    actions = 0
    for f, look in enumerate(looks):
        found = look.detections
        chosen = (found.class_ids == PEDESTRIAN) & (found.scores >= REPORTED)
        boxes = [b for b in found.boxes[chosen].astype(np.float64) if truth.seen(f, b)]
        people = [b[f] for b in truth.people.values() if f in b]
        actions += len(boxes) + _one_by_one(boxes, people)
    return actions


def _one_by_one(boxes: list[Array], people: list[Array]) -> int:
    """Drags, and boxes made by hand, until each of the people of a frame has a right box."""
    actions, free = 0, list(boxes)
    for true in people:
        near = min(free, key=lambda b: distance(b, true), default=None)
        if near is None or distance(near, true) > REACH:
            actions += PLACE + ADJUST
            continue
        free = [b for b in free if b is not near]
        actions += not is_right(near, true)
    return actions


def totals(results: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Of several drives: the sums, and the shares of what labelling by hand takes."""
    keys = ("people", "boxes", "looked_at", "actions", "corrections_in_full", "by_hand",
            "without_tracks")
    sums = {key: sum(int(r[key]) for r in results.values()) for key in keys}
    hand = max(sums["by_hand"], 1)
    return {**sums, "share_of_by_hand": sums["actions"] / hand,
            "share_corrected_in_full": sums["corrections_in_full"] / hand,
            "share_without_tracks": sums["without_tracks"] / hand}

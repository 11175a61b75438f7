"""Simulated annotator: a script that knows the ground truth labels the pedestrians of a drive as a
person would on the page, and counts the actions.

Clicks, keys and drags that change or select labels are counted. Looking through frames is not, as
labelling by hand needs it as well.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lidar_perception.geometry import bev_iou, points_in_box
from lidar_perception.types import CLASSES, PEDESTRIAN, InputError
from lidar_studio.proposer import SAME_TRACK_DISTANCE_M
from lidar_studio.session import Session
from lidar_studio.state import ACCEPTED, PROPOSED, Track, find_next_uncertain
from lidar_studio.survey import FrameSurvey

Array = np.ndarray[Any, Any]
MIN_OVERLAP, MAX_CENTRE_ERROR_M = 0.7, 0.2  # a box is right with either, both in BEV
PLACE_ACTIONS, ADJUST_ACTIONS = 1, 3  # to place a box by hand; to correct place, size and heading
PERSON = CLASSES[PEDESTRIAN]
MIN_SHOWN_SCORE = 0.4  # of a detection, when labelling without tracks
MAX_ROUNDS = 1000      # corrections of one person; more indicate a bug


class Truth:
    """The labelled pedestrians of a drive. people: boxes (7,) by track id and frame."""

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
        """Number of labelled boxes."""
        return sum(map(len, self.people.values()))

    def is_labelled_place(self, frame: int, box: Array) -> bool:
        """Return True if objects at a box (7,) would be labelled: in the camera's view, if any."""
        camera = self._cameras[frame]
        return camera is None or bool(camera.in_view(box[None, :3])[0])

    def match_person(self, track: Track) -> int | None:
        """Return the id of the person at most of a track's boxes, or None."""
        votes: Counter[int] = Counter()
        for f, box in track.boxes.items():
            centre = np.array(box.values)
            nearest = [(centre_distance(b[f], centre), n) for n, b in self.people.items() if f in b]
            if nearest and min(nearest)[0] <= SAME_TRACK_DISTANCE_M:
                votes[min(nearest)[1]] += 1
        labelled = sum(self.is_labelled_place(f, np.array(b.values))
                       for f, b in track.boxes.items())
        number, count = next(iter(votes.most_common(1)), (-1, 0))
        return number if count > 0 and 2 * count >= labelled else None


def centre_distance(one: Array, other: Array) -> float:
    """Compute the BEV distance between the centres of two boxes (7,), in metres."""
    return float(np.hypot(*(one[:2] - other[:2])))


def is_right(box: Array, true: Array) -> bool:
    """Return True if a box (7,) is close enough to the true one."""
    overlap = bev_iou(box[None], true[None])[0, 0]
    return centre_distance(box, true) <= MAX_CENTRE_ERROR_M or bool(overlap >= MIN_OVERLAP)


class Annotator:
    """Labels the pedestrians of a session with proposals. counts: actions by kind."""

    def __init__(self, session: Session) -> None:
        self.session, self.truth = session, Truth(session)
        self.counts: Counter[str] = Counter()
        self.looked_at: set[int] = set()  # ids of proposals
        self._own: dict[int, int] = {}  # person -> id of the track

    def run(self) -> dict[str, Any]:
        """Label until every pedestrian is right; return the counts. InputError if that fails."""
        surveys = self.session.proposer.surveys or []
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
                "corrections_in_full": self.actions + (ADJUST_ACTIONS - 1) * self.counts["drag"],
                "by_hand": (PLACE_ACTIONS + ADJUST_ACTIONS) * self.truth.boxes,
                "without_tracks": count_actions_without_tracks(surveys, self.truth)}

    @property
    def actions(self) -> int:
        """Number of actions so far."""
        return sum(self.counts.values())

    def _do(self, kind: str, **action: Any) -> None:
        self.session.do(action, "annotator")
        self.session.wait()  # until a seed is tracked
        self.counts[kind] += 1

    def _decide(self) -> None:
        """Accept every proposed pedestrian that is one, with one key each while the pointer is on
        the box, and merge further tracks of the same person with the first."""
        while (track := find_next_uncertain(self.session.state,
                                            condition=self._is_new)) is not None:
            person = self.truth.match_person(track)
            self.looked_at.add(track.id)
            if person is None:
                continue
            self._do("key: accept", do="accept", track=track.id)
            if self._own.setdefault(person, track.id) != track.id:
                self.counts["click: select the other one"] += 1
                self._do("key: merge", do="merge", tracks=[self._own[person], track.id])

    def _is_new(self, track: Track) -> bool:
        """Return True for a pedestrian track that was not looked at, where objects are labelled."""
        return (track.class_name == PERSON and track.id not in self.looked_at and any(
            self.truth.is_labelled_place(f, np.array(b.values)) for f, b in track.boxes.items()))

    def _reject_rest(self) -> None:
        """List only pedestrians and reject all remaining proposals with one key."""
        if any(t.state == PROPOSED and t.id in self.looked_at
               for t in self.session.state.tracks.values()):
            self.counts["click: only pedestrians"] += 1
            self._do("key: reject the rest", do="reject_rest", **{"class": PERSON})

    def _track_of(self, person: int) -> Track:
        return self.session.state.tracks[self._own[person]]

    def _find(self, person: int) -> None:
        """Give a person without a track one: correct the class of a proposal, else click where the
        person is nearest, else place a box there."""
        if person in self._own:
            return
        boxes = self.truth.people[person]
        for track in self.session.state.tracks.values():
            if track.state == PROPOSED and self.truth.match_person(track) == person:
                self._own[person] = track.id
                self.counts["click: select"] += 1
                self._do("key: class", do="class", track=track.id, **{"class": PERSON})
                self._do("key: accept", do="accept", track=track.id)
                return
        frame = min(boxes, key=lambda f: float(np.hypot(*boxes[f][:2])))
        try:
            xyz = self._find_click_point(frame, boxes[frame])
            self._do("click: seed", do="seed", frame=frame, xyz=xyz, **{"class": PERSON})
            self._own[person] = self.session.state.seeds[-1][1]
        except InputError:  # no cluster
            self._own[person] = self.session.state.next_id
            self._do("place", do="add", frame=frame, box=boxes[frame].tolist(),
                     **{"class": PERSON})
            self.counts["adjust"] += ADJUST_ACTIONS

    def _find_click_point(self, frame: int, box: Array) -> list[float]:
        """Return a clustered point of the person near the centre of the box."""
        scan = self.session.drive.load_scan(frame)
        inside = np.flatnonzero(points_in_box(scan.xyz, box, 0.1) & (scan.cluster_ids > 0))
        if len(inside) == 0:
            raise InputError("there is no cluster to click")
        distances = np.linalg.norm(scan.xyz[inside] - box[:3], axis=1)
        return [float(v) for v in scan.xyz[inside[distances.argmin()]]]

    def _finish(self, person: int) -> None:
        """Remove extra boxes, then correct the worst box, until every box is right."""
        boxes = self.truth.people[person]
        for _ in range(MAX_ROUNDS):
            self._trim(person)
            track = self._track_of(person)
            current = {f: np.array(box.values) for f, box in track.boxes.items()}
            wrong = {f: centre_distance(b, current[f]) if f in current else np.inf
                     for f, b in boxes.items() if f not in current or not is_right(current[f], b)}
            if not wrong:
                return
            ranks = {f: (_rank_error(track, f, error), -f) for f, error in wrong.items()}
            self._correct(person, track, max(wrong, key=ranks.__getitem__))
        raise InputError(f"person {person} has wrong boxes after {MAX_ROUNDS} corrections")

    def _correct(self, person: int, track: Track, frame: int) -> None:
        """Drag a box to its true centre; size and heading stay."""
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
        """Trim the track to the person's first and last frame; in between, remove extra boxes one
        by one."""
        boxes = self.truth.people[person]
        for late in (True, False):
            track = self._track_of(person)
            extra = sorted(f for f, b in track.boxes.items() if f not in boxes
                           and self.truth.is_labelled_place(f, np.array(b.values)))
            outside = [f for f in extra if (f > max(boxes) if late else f < min(boxes))]
            if not outside:
                continue
            self._do("key: ends here" if late else "key: begins here", do="trim", track=track.id,
                     frame=max(boxes) if late else min(boxes), side="after" if late else "before")
        track = self._track_of(person)
        for f in sorted(track.boxes):
            if f not in boxes and self.truth.is_labelled_place(f, np.array(track.boxes[f].values)):
                self._do("key: remove", do="remove_box", track=track.id, frame=f)

    def _check(self) -> None:
        """Raise InputError if a pedestrian is wrong, missing, or labelled where there is none."""
        person_of = {track: person for person, track in self._own.items()}
        for track in self.session.state.tracks.values():
            if track.state != ACCEPTED or track.class_name != PERSON:
                continue
            boxes = self.truth.people[person_of[track.id]] if track.id in person_of else {}
            for f, box in track.boxes.items():
                values = np.array(box.values)
                if f in boxes and not is_right(values, boxes[f]):
                    raise InputError(f"frame {f}: track {track.id} is not right")
                if f not in boxes and self.truth.is_labelled_place(f, values):
                    raise InputError(f"frame {f}: there is no person at track {track.id}")
            if missing := boxes.keys() - track.boxes.keys():
                raise InputError(f"track {track.id} has no box in frame {min(missing)}")
        if len(person_of) < len(self.truth.people):
            raise InputError("a person has no track")


def _rank_error(track: Track, frame: int, error: float) -> float:
    """Rank a box for correction: missing ones first, the farthest from others leading, as the
    frames in between are interpolated; then by error."""
    return error if np.isfinite(error) else 1e6 + min(abs(frame - f) for f in track.boxes)


def count_actions_without_tracks(surveys: Sequence[FrameSurvey], truth: Truth) -> int:
    """Count the actions if detections are shown frame by frame, without tracks: a key for each
    detection, a drag for each inexact one, and a box by hand for each missing pedestrian."""
    actions = 0
    for f, survey in enumerate(surveys):
        found = survey.detections
        chosen = (found.class_ids == PEDESTRIAN) & (found.scores >= MIN_SHOWN_SCORE)
        boxes = [b for b in found.boxes[chosen].astype(np.float64) if truth.is_labelled_place(f, b)]
        people = [b[f] for b in truth.people.values() if f in b]
        actions += len(boxes) + _count_corrections(boxes, people)
    return actions


def _count_corrections(boxes: list[Array], people: list[Array]) -> int:
    """Count drags and hand-made boxes until each person of a frame has a right box."""
    actions, free = 0, list(boxes)
    for true in people:
        nearest = min(free, key=lambda b: centre_distance(b, true), default=None)
        if nearest is None or centre_distance(nearest, true) > SAME_TRACK_DISTANCE_M:
            actions += PLACE_ACTIONS + ADJUST_ACTIONS
            continue
        free = [b for b in free if b is not nearest]
        actions += not is_right(nearest, true)
    return actions


def sum_results(results: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Sum the counts of several drives, and compute their shares of labelling by hand."""
    keys = ("people", "boxes", "looked_at", "actions", "corrections_in_full", "by_hand",
            "without_tracks")
    sums = {key: sum(int(r[key]) for r in results.values()) for key in keys}
    hand = max(sums["by_hand"], 1)
    return {**sums, "share_of_by_hand": sums["actions"] / hand,
            "share_corrected_in_full": sums["corrections_in_full"] / hand,
            "share_without_tracks": sums["without_tracks"] / hand}

"""Proposals for the labels as they are: the survey of the drive, run beside the page, and what it
means for the tracks that are there already."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.candidates.configurations import BEST
from lidar_perception.candidates.seeds import Seed, seed_from_points
from lidar_perception.candidates.silhouette import compute_similarity, to_pixels
from lidar_perception.classes import Size
from lidar_perception.detectors.contract import FUSED
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.geometry import centre_distances, points_in_box, to_box_frame
from lidar_perception.types import CLASSES, PEDESTRIAN, InputError
from lidar_studio import survey_cache
from lidar_studio.alike import alike, cell_of, side_view
from lidar_studio.drive import Drive
from lidar_studio.interpolation import Motion, corrected
from lidar_studio.proposals import CANDIDATES, SAME, SeedLook, SeedSize, Wanted, proposed
from lidar_studio.state import KEY, Box, State, Track
from lidar_studio.survey import Look, surveyed

Array = np.ndarray[Any, Any]
MARGIN = 0.1    # metres around a box whose points are a seed's
FEWEST = 5      # points of what is compared with a seed
SHARE = 0.5     # of the boxes of the shorter of two tracks that are one
REACH = 0.7     # metres between the centres of boxes that are one, or this share of the length:
ALONG = 0.4


class Proposer:
    """Proposals for a drive. detector: the one that looks, None for none. kept:
    the folder that keeps the survey, None for none. problem: what is wrong with what is kept, or
    ""."""

    def __init__(self, drive: Drive, detector: DetectorChoice | None = DetectorChoice(),
                 kept: Path | None = None) -> None:
        self.drive, self.detector, self.kept = drive, detector, kept
        self.problem = ""
        self._seen: list[Look] = []  # of the first frames
        self._seeds: dict[tuple[int, tuple[float, ...]], Seed | None] = {}

    @property
    def looks(self) -> list[Look] | None:
        """Of all frames; None where they are not all surveyed yet."""
        return self._seen if len(self._seen) == len(self.drive.frames) else None

    @cached_property
    def _key(self) -> str:
        return survey_cache.key_of(self.drive, self.detector)

    def remember(self) -> None:
        """Take the looks that were kept, where they are of this drive and this detector."""
        if self.kept is None or self._seen or not self.kept.is_dir():
            return
        try:
            self._seen, self.problem = survey_cache.read(self.kept, self._key)
        except InputError as error:
            self.problem = str(error)

    def survey(self, done: Callable[[int], bool], here: bool = False) -> bool:
        """Look at all frames that were not yet, in a process of its own or here, and keep that;
        done is told how many are, and says whether to go on. Whether all were."""
        looks = self._seen
        if self.kept is not None and not looks:
            survey_cache.clear(self.kept)
        with closing(surveyed(self.drive, self.detector, here, len(looks))) as survey:
            for look in survey:
                if look is not None:
                    looks.append(look)
                    self._keep(looks)
                if not done(len(looks)):
                    return False
        return True

    def _keep(self, looks: list[Look]) -> None:
        """The last piece, once it is whole."""
        whole = len(looks) % survey_cache.PIECE == 0 or len(looks) == len(self.drive.frames)
        if self.kept is None or not whole:
            return
        first = (len(looks) - 1) // survey_cache.PIECE * survey_cache.PIECE
        try:
            survey_cache.write(self.kept, self._key, first, looks[first:])
        except InputError as error:
            self.problem = str(error)

    def poses(self) -> list[list[float]] | None:
        """Of the frames, by the scans, where the drive has none; None where they are unknown."""
        if self.drive.motion.poses is not None or not self.looks:
            return None
        found = [look.pose for look in self.looks if look.pose is not None]
        return [np.round(pose, 6).ravel().tolist() for pose in found] if len(found) == len(
            self.looks) else None

    def proposals(self, state: State, motion: Motion, frames: range | None = None,
                  told: Callable[[int], bool] = lambda count: True) -> list[Track] | None:
        """The tracks that there are in some frames, None for all, of a drive that is surveyed; told
        as in proposed()."""
        seeds = [SeedLook(seed.silhouette(BEST), seed.height) for seed in self.seeds(state)]
        sizes = [SeedSize(t.class_name, _size(t, f))
                 for f, t in self._things(state)]
        placed: dict[int, list[tuple[Array, str]]] = {}
        for t in state.tracks.values():
            for f, b in t.boxes.items() if t.placed else ():
                if b.kind == KEY:
                    placed.setdefault(f, []).append((np.array(b.values), t.class_name))
        stamps = [frame.stamp_ns for frame in self.drive.frames]
        wanted = Wanted(seeds, sizes, placed, self.detector is not None)
        return proposed(self.looks or [], wanted, stamps, motion,
                        range(len(self.looks or [])) if frames is None else frames, told)

    def _things(self, state: State) -> list[tuple[int, Track]]:
        """The seeds that are no pedestrians: frame and track."""
        found = [(f, state.tracks[t]) for f, t in state.seeds if t in state.tracks]
        return [(f, t) for f, t in found if f in t.boxes and t.class_name in CLASSES
                and t.class_name != CLASSES[PEDESTRIAN]]

    def seeds(self, state: State) -> list[Seed]:
        """Those of the state that have points enough."""
        found = [self._seed(state.tracks[t], f) for f, t in state.seeds if t in state.tracks]
        return [seed for seed in found if seed is not None]

    def _seed(self, track: Track, frame: int) -> Seed | None:
        if frame not in track.boxes or track.class_name != CLASSES[PEDESTRIAN]:
            return None
        box = track.boxes[frame].values
        if (frame, box) not in self._seeds:
            self._seeds[frame, box] = self.cut_out(np.array(box), frame)
        return self._seeds[frame, box]

    def cut_out(self, box: Array, frame: int) -> Seed | None:
        """What is in a box (7,) of a frame, as a seed; None where it has too few points."""
        try:
            return seed_from_points(self._inside(frame, box), box, certain=True)
        except InputError:
            return None

    def silhouettes(self, state: State, track: Track, frame: int) -> dict[str, Any]:
        """Of the seed that a candidate is most like, and of the candidate, as the page has them; of
        what is no pedestrian, the view from the side. InputError where there is none."""
        if track.class_name != CLASSES[PEDESTRIAN]:
            return self._sides(state, track, frame)
        seeds = self.seeds(state)
        if not seeds:
            raise InputError("there is no seed yet; click a pedestrian")
        box = track.boxes.get(frame)
        seen = None if box is None else self.cut_out(np.array(box.values), frame)
        if seen is None:
            raise InputError(f"track {track.id} has too few points in frame {frame} to be compared")
        image, templates = seen.silhouette(BEST), [seed.silhouette(BEST) for seed in seeds]
        scores = [float(compute_similarity(image[None], t, BEST.stm)[0]) for t in templates]
        best = int(np.argmax(scores))
        return {"seed": _drawn(to_pixels(templates[best])), "candidate": _drawn(to_pixels(image)),
                "similarity": scores[best]}

    def _sides(self, state: State, track: Track, frame: int) -> dict[str, Any]:
        seeds = [(f, t) for f, t in self._things(state) if t.class_name == track.class_name]
        if not seeds:
            raise InputError(f"there is no seed of class {track.class_name} yet; click one")
        if frame not in track.boxes:
            raise InputError(f"track {track.id} has no box in frame {frame}")
        box = np.array(track.boxes[frame].values)
        seen = to_box_frame(self._inside(frame, box), box)
        if len(seen) < FEWEST:
            raise InputError(f"track {track.id} has too few points in frame {frame} to be compared")
        # As the heading of the box is known, no L-shape need be found.
        sides, shape = np.ptp(seen[:, :2], axis=0), box.copy()
        shape[3:6] = sides.max(), sides.min(), seen[:, 2].max() + box[5] / 2
        scores = [float(alike(shape[None], _size(t, f))[0])
                  for f, t in seeds]
        f, seed = seeds[int(np.argmax(scores))]
        like = np.array(seed.boxes[f].values)
        cell = cell_of(box, like)
        return {"seed": _drawn(side_view(self._inside(f, like), like, cell)),
                "candidate": _drawn(side_view(self._inside(frame, box), box, cell)),
                "similarity": max(scores)}

    def _inside(self, frame: int, box: Array) -> Array:
        scan = self.drive.clouds(frame)
        return scan.xyz[points_in_box(scan.xyz, box, MARGIN) & ~scan.ground]

    def detected(self, frame: int, box: Array, class_name: str) -> Array:
        """(7,) the box of a detection of the class where a clicked cluster's box (7,) is; that one
        where there is none."""
        if self.looks is None or class_name not in CLASSES:
            return box
        found = self.looks[frame].detections
        found = found[found.class_ids == CLASSES.index(class_name)]
        apart = centre_distances(found.boxes, box[None])[:, 0]
        if apart.min(initial=np.inf) > max(SAME, ALONG * box[3]):
            return box
        return found.boxes[int(apart.argmin())].astype(np.float64)


def _size(track: Track, frame: int) -> Size:
    length, width, height = track.boxes[frame].values[3:6]
    return length, width, height


def _drawn(pixels: Array) -> dict[str, Any]:
    return {"rows": pixels.shape[0], "cols": pixels.shape[1],
            "bits": "".join("01"[bit] for bit in pixels.ravel().astype(int))}


def merged(state: State, made: Sequence[Track], motion: Motion) -> tuple[list[Track], list[int]]:
    """What new proposals mean for the tracks that are there: those that a person has had a hand in
    stay, but for one that was placed, which is followed through the drive, or stays where it was
    put if no proposal is there; a proposal where one was before takes its place and id; proposals
    that are no more are removed."""
    there = _Places(state.tracks)
    waiting = {t.id for t in state.tracks.values()
               if not t.touched and t.source in (FUSED, CANDIDATES)}
    found: list[Track] = []
    free, taken = state.next_id, set[int]()
    for new in made:
        old = there.same(new)
        by_person = [t for t in old if t.id not in waiting]
        if by_person:
            placed = next((t for t in by_person if t.placed and t.id not in taken), None)
            if placed is not None:
                taken.add(placed.id)
                found.append(followed(placed, new.boxes, motion))
            continue
        number = next((t.id for t in old if t.id not in taken), free)
        free += number == free
        taken.add(number)
        found.append(replace(new, id=number))
    found += [followed(t, {}, motion) for t in state.tracks.values()
              if t.placed and t.id not in taken]
    return ([t for t in found if t != state.tracks.get(t.id)], sorted(waiting - taken))


def followed(placed: Track, boxes: Mapping[int, Box], motion: Motion) -> Track:
    """A track that was placed, through the frames of a proposal with these boxes: corrected by
    each box that a person gave it."""
    found: Mapping[int, Box] = {f: b for f, b in boxes.items() if f not in placed.gone}
    for frame, box in sorted(placed.boxes.items()):
        if box.kind == KEY:
            found = corrected(found, placed.gone, frame, box.values, motion)
    return replace(placed, boxes=dict(sorted(found.items())), nearby=False)


class _Places:
    """Where tracks are, by frame."""

    def __init__(self, tracks: Mapping[int, Track]) -> None:
        self._tracks = tracks
        rows: dict[int, list[tuple[float, ...]]] = {}
        for t in tracks.values():
            for f, b in t.boxes.items():
                rows.setdefault(f, []).append((t.id, b.values[0], b.values[1], b.values[3]))
        self._rows = {f: np.array(r) for f, r in rows.items()}

    def same(self, new: Track) -> list[Track]:
        """Those that are one with a proposal, the one with the most boxes in common first."""
        votes: Counter[int] = Counter()
        for f, b in new.boxes.items():
            rows = self._rows.get(f)
            if rows is not None:
                apart = np.hypot(rows[:, 1] - b.values[0], rows[:, 2] - b.values[1])
                near = apart <= np.maximum(REACH, ALONG * np.minimum(rows[:, 3], b.values[3]))
                votes.update(rows[near, 0].astype(int).tolist())
        shorter = {n: min(len(self._tracks[n].boxes), len(new.boxes)) for n in votes}
        return [self._tracks[n] for n, count in votes.most_common() if count >= SHARE * shorter[n]]

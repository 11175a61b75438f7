"""Track proposals for a labelling session: survey of the drive, seeds, and merging with existing tracks."""

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
from lidar_perception.geometry import centre_distances, points_in_box
from lidar_perception.types import CLASSES, PEDESTRIAN, InputError
from lidar_studio import survey_cache
from lidar_studio.drive import Drive
from lidar_studio.interpolation import Motion, apply_correction
from lidar_studio.proposals import (
    CANDIDATES,
    SAME_OBJECT_DISTANCE_M,
    ProposalRequest,
    SilhouetteSeed,
    SizeSeed,
    propose_tracks,
)
from lidar_studio.state import KEY, Box, State, Track
from lidar_studio.survey import FrameSurvey, survey_drive

Array = np.ndarray[Any, Any]
BOX_MARGIN_M = 0.1  # margin around a box when selecting its points
# Two tracks are the same object if this fraction of the shorter track's boxes coincide.
MIN_COMMON_FRACTION = 0.5
# Maximum distance between the centres of coinciding boxes: the larger of a distance and a fraction of the length.
SAME_TRACK_DISTANCE_M, SAME_TRACK_LENGTH_FRACTION = 0.7, 0.4


class Proposer:
    """Proposer of tracks in a drive.

    Attributes:
        detector: Detector to use, or None to propose tracks from seeds only.
        folder: Folder of the survey cache, or None for no cache.
        problem: Error message of the cache, or "".
    """

    def __init__(
        self, drive: Drive, detector: DetectorChoice | None = DetectorChoice(), folder: Path | None = None
    ) -> None:
        self.drive, self.detector, self.folder = drive, detector, folder
        self.problem = ""
        self._surveys: list[FrameSurvey] = []  # surveys of the first frames, until all are surveyed
        self._seeds: dict[tuple[int, tuple[float, ...]], Seed | None] = {}

    @property
    def surveys(self) -> list[FrameSurvey] | None:
        """Surveys of all frames, or None until all frames are surveyed."""
        return self._surveys if len(self._surveys) == len(self.drive.frames) else None

    @cached_property
    def _key(self) -> str:
        return survey_cache.make_key(self.drive, self.detector)

    def load_cached(self) -> None:
        """Load the cached survey if it belongs to this drive and detector."""
        if self.folder is None or self._surveys or not self.folder.is_dir():
            return
        try:
            self._surveys, self.problem = survey_cache.read(self.folder, self._key)
        except InputError as error:
            self.problem = str(error)

    def run_survey(self, on_progress: Callable[[int], bool]) -> bool:
        """Survey the remaining frames and cache the result; return False if cancelled.

        Args:
            on_progress: Function called with the number of surveyed frames, which returns False to cancel.
        """
        surveys = self._surveys
        if self.folder is not None and not surveys:
            survey_cache.clear(self.folder)
        with closing(survey_drive(self.drive, self.detector, len(surveys))) as new_surveys:
            for survey in new_surveys:
                if survey is not None:
                    surveys.append(survey)
                    self._write_last_file(surveys)
                if not on_progress(len(surveys)):
                    return False
        return True

    def _write_last_file(self, surveys: list[FrameSurvey]) -> None:
        """Write the last file of the cache if all its frames are surveyed."""
        size = survey_cache.FRAMES_PER_FILE
        is_complete = len(surveys) % size == 0 or len(surveys) == len(self.drive.frames)
        if self.folder is None or not is_complete:
            return
        first = (len(surveys) - 1) // size * size
        try:
            survey_cache.write(self.folder, self._key, first, surveys[first:])
        except InputError as error:
            self.problem = str(error)

    def collect_scan_poses(self) -> list[list[float]] | None:
        """Return the poses from scan matching as 16 numbers per frame.

        Returns None if the recording contains poses or scan matching failed.
        """
        if self.drive.motion.poses is not None or not self.surveys:
            return None
        poses = [survey.pose for survey in self.surveys if survey.pose is not None]
        return [np.round(pose, 6).ravel().tolist() for pose in poses] if len(poses) == len(self.surveys) else None

    def make_proposals(
        self,
        state: State,
        motion: Motion,
        frames: range | None = None,
        on_progress: Callable[[int], bool] = lambda count: True,
    ) -> list[Track] | None:
        """Propose tracks in a surveyed drive.

        Args:
            frames: Frames to use, or None for all.
            on_progress: See propose_tracks().

        Returns:
            The proposed tracks, or None if cancelled.
        """
        silhouettes = [SilhouetteSeed(seed.draw_silhouette(BEST), seed.height) for seed in self.find_seeds(state)]
        sizes = [SizeSeed(t.class_name, _get_size(t, f)) for f, t in self._find_size_seeds(state)]
        placed_boxes: dict[int, list[tuple[Array, str]]] = {}
        for t in state.tracks.values():
            for f, b in t.boxes.items() if t.awaits_tracking else ():
                if b.kind == KEY:
                    placed_boxes.setdefault(f, []).append((np.array(b.values), t.class_name))
        stamps = [frame.stamp_ns for frame in self.drive.frames]
        request = ProposalRequest(silhouettes, sizes, placed_boxes, self.detector is not None)
        surveys = self.surveys or []
        return propose_tracks(
            surveys, request, stamps, motion, range(len(surveys)) if frames is None else frames, on_progress
        )

    def _find_size_seeds(self, state: State) -> list[tuple[int, Track]]:
        """Return the frame and track of each seed that is not a pedestrian."""
        seeds = [(f, state.tracks[t]) for f, t in state.seeds if t in state.tracks]
        return [
            (f, t) for f, t in seeds if f in t.boxes and t.class_name in CLASSES and t.class_name != CLASSES[PEDESTRIAN]
        ]

    def find_seeds(self, state: State) -> list[Seed]:
        """Return the pedestrian seeds that have enough points."""
        seeds = [self._make_seed(state.tracks[t], f) for f, t in state.seeds if t in state.tracks]
        return [seed for seed in seeds if seed is not None]

    def _make_seed(self, track: Track, frame: int) -> Seed | None:
        if frame not in track.boxes or track.class_name != CLASSES[PEDESTRIAN]:
            return None
        box = track.boxes[frame].values
        if (frame, box) not in self._seeds:
            self._seeds[frame, box] = self.cut_seed(np.array(box), frame)
        return self._seeds[frame, box]

    def cut_seed(self, box: Array, frame: int) -> Seed | None:
        """Make a seed from the points in a box (7,) of a frame, or return None if there are too few."""
        try:
            return seed_from_points(self._select_points(frame, box), box, confidence=1.0)
        except InputError:
            return None

    def compare_with_seed(self, state: State, track: Track, frame: int) -> dict[str, Any]:
        """Compare the silhouette of a pedestrian in a frame with the most similar seed.

        Returns:
            The JSON object of /api/silhouettes.

        Raises:
            InputError: There is no seed, or the pedestrian has too few points in this frame.
        """
        seeds = self.find_seeds(state) if track.class_name == CLASSES[PEDESTRIAN] else []
        if not seeds:
            raise InputError("no pedestrian seed to compare with; click a pedestrian first")
        box = track.boxes.get(frame)
        candidate = None if box is None else self.cut_seed(np.array(box.values), frame)
        if candidate is None:
            raise InputError(f"track {track.id} has too few points in frame {frame} for a silhouette")
        image, templates = candidate.draw_silhouette(BEST), [seed.draw_silhouette(BEST) for seed in seeds]
        scores = [float(compute_similarity(image[None], t, BEST.stm)[0]) for t in templates]
        best_index = int(np.argmax(scores))
        return {
            "seed": _pixels_to_json(to_pixels(templates[best_index])),
            "candidate": _pixels_to_json(to_pixels(image)),
            "similarity": scores[best_index],
        }

    def _select_points(self, frame: int, box: Array) -> Array:
        scan = self.drive.load_scan(frame)
        return scan.xyz[points_in_box(scan.xyz, box, BOX_MARGIN_M) & ~scan.ground]

    def refine_with_detection(self, frame: int, box: Array, class_name: str) -> Array:
        """Return the box (7,) of the nearest detection of the class, or `box` (7,) if none is close to it."""
        if self.surveys is None or class_name not in CLASSES:
            return box
        detections = self.surveys[frame].detections
        detections = detections[detections.class_ids == CLASSES.index(class_name)]
        distances = centre_distances(detections.boxes, box[None])[:, 0]
        if distances.min(initial=np.inf) > max(SAME_OBJECT_DISTANCE_M, SAME_TRACK_LENGTH_FRACTION * box[3]):
            return box
        return detections.boxes[int(distances.argmin())].astype(np.float64)


def _get_size(track: Track, frame: int) -> Size:
    length, width, height = track.boxes[frame].values[3:6]
    return length, width, height


def _pixels_to_json(pixels: Array) -> dict[str, Any]:
    return {
        "rows": pixels.shape[0],
        "cols": pixels.shape[1],
        "bits": "".join("01"[bit] for bit in pixels.ravel().astype(int)),
    }


def merge_proposals(state: State, proposals: Sequence[Track], motion: Motion) -> tuple[list[Track], list[int]]:
    """Merge new proposals with the existing tracks.

    Tracks that a person accepted, rejected or edited are kept. A proposal that matches a clicked track
    extends it. Old proposals are replaced by new proposals that match them, with the same ids; all
    other old proposals are removed.

    Returns:
        New and changed tracks, and the ids of removed tracks.
    """
    index = _TrackIndex(state.tracks)
    unconfirmed_ids = {t.id for t in state.tracks.values() if not t.has_human_edits and t.source in (FUSED, CANDIDATES)}
    changed_tracks: list[Track] = []
    next_id, used_ids = state.next_id, set[int]()
    for proposal in proposals:
        matches = index.find_matches(proposal)
        human_tracks = [t for t in matches if t.id not in unconfirmed_ids]
        if human_tracks:
            clicked_track = next((t for t in human_tracks if t.awaits_tracking and t.id not in used_ids), None)
            if clicked_track is not None:
                used_ids.add(clicked_track.id)
                changed_tracks.append(extend_track(clicked_track, proposal.boxes, motion))
            continue
        track_id = next((t.id for t in matches if t.id not in used_ids), next_id)
        next_id += track_id == next_id
        used_ids.add(track_id)
        changed_tracks.append(replace(proposal, id=track_id))
    changed_tracks += [
        extend_track(t, {}, motion) for t in state.tracks.values() if t.awaits_tracking and t.id not in used_ids
    ]
    return [t for t in changed_tracks if t != state.tracks.get(t.id)], sorted(unconfirmed_ids - used_ids)


def extend_track(track: Track, proposed_boxes: Mapping[int, Box], motion: Motion) -> Track:
    """Replace the boxes of a clicked track by proposed boxes, corrected by the track's key boxes."""
    boxes: Mapping[int, Box] = {f: b for f, b in proposed_boxes.items() if f not in track.removed_frames}
    for frame, box in sorted(track.boxes.items()):
        if box.kind == KEY:
            boxes = apply_correction(boxes, track.removed_frames, frame, box.values, motion)
    return replace(track, boxes=dict(sorted(boxes.items())), is_partly_tracked=False)


class _TrackIndex:
    """Index of the positions of tracks by frame."""

    def __init__(self, tracks: Mapping[int, Track]) -> None:
        self._tracks = tracks
        rows: dict[int, list[tuple[float, ...]]] = {}
        for t in tracks.values():
            for f, b in t.boxes.items():
                rows.setdefault(f, []).append((t.id, b.values[0], b.values[1], b.values[3]))
        self._rows = {f: np.array(r) for f, r in rows.items()}

    def find_matches(self, proposal: Track) -> list[Track]:
        """Return the tracks of the same object, sorted by the number of coinciding boxes (most first)."""
        common_counts: Counter[int] = Counter()
        for f, b in proposal.boxes.items():
            rows = self._rows.get(f)
            if rows is not None:
                distances = np.hypot(rows[:, 1] - b.values[0], rows[:, 2] - b.values[1])
                lengths = np.minimum(rows[:, 3], b.values[3])
                coincides = distances <= np.maximum(SAME_TRACK_DISTANCE_M, SAME_TRACK_LENGTH_FRACTION * lengths)
                common_counts.update(rows[coincides, 0].astype(int).tolist())
        min_lengths = {n: min(len(self._tracks[n].boxes), len(proposal.boxes)) for n in common_counts}
        return [
            self._tracks[n] for n, count in common_counts.most_common() if count >= MIN_COMMON_FRACTION * min_lengths[n]
        ]

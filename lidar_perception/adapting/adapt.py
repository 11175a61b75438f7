"""Adapting: look at the drives, judge, learn, and take what is not worse; the same again."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from hashlib import sha1
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.adapting.drives import (
    Piece,
    Refused,
    checked,
    frames_of,
    pieces_of,
    poses_of,
    require_motion,
    seconds_of,
    turned_problem,
)
from lidar_perception.adapting.hearing import Counts, Heard, heard_of, recognised, unheard
from lidar_perception.adapting.judging import KEPT, STATES, Verdict, judged
from lidar_perception.adapting.labels import ConcludedLabels, labels_of
from lidar_perception.adapting.learning import (
    network_to_train,
    opened_with,
    simulated_frames,
    simulated_score,
    training_params,
)
from lidar_perception.adapting.looking import FrameLook, Looker
from lidar_perception.adapting.params import (
    BEST,
    HEARD,
    JUDGED,
    POSES,
    RECORD,
    ROUND,
    SCANS,
    AdaptParams,
)
from lidar_perception.adapting.scenes import AdaptedScenes, save_labels
from lidar_perception.adapting.tracks import Followed, tracks_of
from lidar_perception.adapting.watch import Watched, agreement_of, confirmed_share, worse
from lidar_perception.classes import CLASSES
from lidar_perception.data.open import open_recording
from lidar_perception.detectors.checkpoint import read_header
from lidar_perception.detectors.open import open_detector
from lidar_perception.ground.segment import first_clouds, mount_problem, mounted
from lidar_perception.runs.files import make_folder, read_text, write_bytes, write_text
from lidar_perception.runs.resuming import differences, digest
from lidar_perception.runs.terminal import duration, errors, track
from lidar_perception.simulation.scene import Scenes
from lidar_perception.simulation.sensor import sensor_named
from lidar_perception.tracking.ego import NO_SOURCE, recorded_source
from lidar_perception.training.asked import Asked
from lidar_perception.training.cache import kept as made_once
from lidar_perception.training.plan import TooShort
from lidar_perception.training.sources import SIM
from lidar_perception.training.start import start
from lidar_perception.training.trained_for import as_trained
from lidar_perception.types import InputError

LAST = "last.safetensors"
LOOKING = 0.3     # of the budget, to look at frames
LEARNING = 0.5    # of it, to learn; what is left is for the poses and to judge
MEASURED = 3      # frames that are looked at to know how long one takes
MOST_HELD = 24    # at most so many frames of those that are held out judge a round
FEWEST_KEPT = 3   # objects: of less there is nothing to learn


@dataclass(frozen=True)
class Seen:
    """A piece, the objects followed through it with what was made of them, and the labels of its
    frames."""

    piece: Piece
    looks: list[FrameLook]
    tracks: list[Followed]
    verdicts: list[Verdict]
    labels: list[ConcludedLabels]


@dataclass(frozen=True)
class Round:
    """counts: objects by state and class; after: how its weights were judged; refused: why they
    were not taken, empty if they were."""

    counts: dict[str, dict[str, int]]
    after: Watched
    refused: str


class Adapting:
    """The adapting of a detector: all that takes long is in a file of its own in out, so that a
    resumed run goes on where the other one was.

    data: a recording; weights: a checkpoint, which stays as it is; out: a folder; hours: how long
    all may take; device and jobs as of a training. InputError for what cannot be used.
    """

    def __init__(self, data: Path, weights: Path, out: Path, hours: float, params: AdaptParams,
                 device: str = "auto", jobs: int = 0) -> None:
        self.data, self.weights, self.out = data, weights, out
        self.hours, self.device, self.jobs = hours, device, jobs
        if not 0 < hours < np.inf:
            raise InputError(f"--budget {hours:g} must be a number of hours above 0")
        self.header = read_header(weights)
        recording = open_recording(data, sensor_height=params.mount_height or None)
        clouds = first_clouds(recording)
        self.frames = frames_of(mounted(recording, clouds))
        self.height = self.frames[0].sensor_height
        self.params = as_trained(params, self.header)
        Scenes(scene=self.params.scene).sorts()  # InputError for what is none
        self.sensor = sensor_named(self.params.sensor, self.height)
        if recorded_source(self.frames[0].pose() is not None) == NO_SOURCE:
            raise InputError(f"{data} has no poses, and to find them by the scans needs kiss-icp; "
                             "pip install 'lidar_perception[odometry]'")
        for line in filter(None, (*checked(self.frames, data), mount_problem(recording, clouds))):
            errors.print(line)
        self.network = network_to_train(self.header)
        # All sources with weights, opened once while these are looked with.
        self.opened = lru_cache(maxsize=1)(partial(opened_with, header=self.header, device=device))
        config = self.opened(weights).config
        self.low, self.high = np.array(config.low[:2]), np.array(config.high[:2])
        self.pieces: list[Piece] = []
        self.poses: list[np.ndarray] = []
        self.seen: list[Seen] = []
        self.first_seen: list[Seen] = []
        self.recognised: Counts = {}
        self.before: Watched | None = None
        self.rounds: list[Round] = []
        self.best = weights

    def run(self) -> None:
        """All rounds; then best is what was taken last, and what there was is in seen and
        rounds."""
        self._choose()
        self.poses = [self._poses(i) for i in range(len(self.pieces))]
        require_motion(self.poses, self.data)
        if problem := turned_problem(self.poses, self.data):
            errors.print(problem)
        self.recognised = self._recognised()
        for number in range(1, self.params.rounds + 1):
            if not self._round(number):
                break
        write_bytes(self.out / BEST, self.best.read_bytes())
        self._record()

    def clear(self) -> None:
        """Remove what a refused run has made, its record last, and the folder if nothing else is in
        it."""
        for path in (self.out / name for name in (HEARD, POSES, SCANS, ROUND.format(1), RECORD)):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
        with suppress(OSError):
            self.out.rmdir()

    def asked(self) -> dict[str, Any]:
        """What a resumed run must have in common."""
        return {"data": str(self.data), "weights": sha1(self.weights.read_bytes()).hexdigest(),
                "params": asdict(self.params), "height": self.height,
                "frame_names": digest(f"{frame.sequence} {frame.name}" for frame in self.frames)}

    def _choose(self) -> None:
        """Which frames, by the time that one takes, unless an earlier start chose."""
        path = self.out / RECORD
        asked = json.loads(json.dumps(self.asked()))
        make_folder(self.out)
        if path.is_file():
            text = read_text(path, 10**8)
            try:
                known = json.loads(text)
                most, different = int(known["frames"]), differences(known["asked"], asked)
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                raise InputError(f"cannot read {path}: {error!r}; give another --out, or start "
                                 "again with --force") from None
            if different:
                raise InputError(f"{self.out} holds a run with {'; '.join(different[:3])}; resume "
                                 "it with the same settings, or give another --out")
            errors.print(f"resuming {self.out}")
        else:
            most = self.params.frames or self._affordable()
        self.pieces = pieces_of(self.frames, most)
        count = sum(len(piece.numbers) for piece in self.pieces)
        errors.print(f"{count} of {len(self.frames)} frames, pieces: {len(self.pieces)}, rounds: "
                     f"{self.params.rounds}; mixed with {self.params.scene} scans of "
                     f"{self.params.sensor} at {self.height:g} m")
        if not path.is_file():
            write_text(path, json.dumps({"asked": asked, "frames": most}, indent=1))

    def _affordable(self) -> int:
        errors.print("measuring this machine with a few frames ...")
        looker = Looker(self.opened(self.weights))
        looker(self.frames[0], np.eye(4))
        begun = time.monotonic()
        for frame in self.frames[1:1 + MEASURED]:
            looker(frame, np.eye(4))
        each = (time.monotonic() - begun) / MEASURED
        most = int(3600 * self.hours * LOOKING / self.params.rounds / each)
        errors.print(f"a look at a frame takes {each:.2g} s: up to {most} frames a round, "
                     f"{duration(3600 * self.hours)} in all")
        return max(most, 1)

    def _poses(self, i: int) -> np.ndarray:
        piece = self.pieces[i]

        def made() -> np.ndarray:
            return np.array(list(track(poses_of(self.frames, piece), f"poses of {piece.name}",
                                       len(piece.numbers))))
        return made_once(self.out / POSES / f"{i:03}.npz", made, lambda a: a["poses"],
                         lambda poses: {"poses": poses})

    @property
    def heard(self) -> Heard:
        """Which sources are asked."""
        return heard_of(self.recognised)

    @property
    def not_asked(self) -> list[str]:
        """What to say of those that are not."""
        return unheard(self.recognised)

    def _recognised(self) -> Counts:
        path = self.out / HEARD
        if not path.is_file():
            frames = simulated_frames(self._training(self.out), self._params(1), self.sensor)
            looker = Looker(self.opened(self.weights))
            write_text(path, json.dumps(recognised(looker, track(frames, "looking at simulated "
                                                                 "scans", len(frames)))))
        counts: Counts = json.loads(read_text(path, 10**6))
        for line in unheard(counts):
            errors.print(line)
        return counts

    def _round(self, number: int) -> bool:
        """One round; whether its weights were taken."""
        folder = self.out / ROUND.format(number)
        errors.print(f"round {number} of {self.params.rounds}", style="bold")
        looker = Looker(self.opened(self.best))
        seen = [self._look(i, folder / "looks", looker) for i in range(len(self.pieces))]
        if number == 1:
            self.first_seen = seen
        counts = counted(seen)
        for state in STATES:
            errors.print(f"{state}: " + (", ".join(f"{count} {name}" for name, count in
                                                   counts[state].items()) or "nothing"))
        if (agreed := sum(counts[KEPT].values())) < FEWEST_KEPT:
            few = (f"the detectors agree on {agreed} object{'s' * (agreed != 1)} only, too few to "
                   "learn from")
            if self.rounds:  # what was learned from stays seen
                errors.print(f"round {number} is not made: {few}; {self.best} stays")
                return False
            self.seen = seen
            raise Refused(
                f"{self.data}: {few} ({FEWEST_KEPT}); record more, give --mount-height if it is "
                "not right, or train for the sensor first (train --sensor)")
        self.seen = seen
        if self.before is None:
            self.before = self._watch(self.out / JUDGED, self.weights)
        taught = self._learn(folder)
        after = self._watch(folder / JUDGED, taught)
        refused = next((why for known in (self.before, *(each.after for each in self.rounds))
                        if (why := worse(known, after, self.params))), "")
        self.rounds.append(Round(counts, after, refused))
        self._record()
        if refused:
            errors.print(f"round {number} is not taken: {refused}; {self.best} stays")
            return False
        self.best = taught
        return True

    def _look(self, i: int, folder: Path, looker: Looker) -> Seen:
        piece = self.pieces[i]
        looks = [made_once(folder / f"{n:06}.npz", partial(looker, self.frames[n], pose),
                           FrameLook.of, FrameLook.arrays)
                 for n, pose in track(list(zip(piece.numbers, self.poses[i])),
                                      f"looking at {piece.name}", len(piece.numbers))]
        seconds = seconds_of(self.frames, piece)
        tracks = tracks_of(looks, (1e9 + seconds * 1e9).astype(np.int64).tolist())
        way = np.linalg.inv(self.poses[i][0]) @ self.poses[i]
        heard = self.heard
        verdicts = [judged(each, way[:, :2, 3], heard) for each in tracks]
        return Seen(piece, looks, tracks, verdicts, labels_of(tracks, verdicts, way, seconds))

    def _learn(self, folder: Path) -> Path:
        """The weights after a training on what is kept, the average over its steps."""
        taught, labels = folder / LAST, folder / "labels.npz"
        if taught.is_file():
            return taught
        chosen = [(seen.piece.numbers[k], seen.labels[k]) for seen in self.seen
                  for k in seen.piece.learned]
        save_labels(labels, *zip(*chosen))
        own = AdaptedScenes(self.data, labels, tuple(self.low.tolist()), tuple(self.high.tolist()),
                            self.height)
        share = LEARNING / self.params.rounds
        hours = None if self.params.steps else share * self.hours
        try:
            ended = start(self.network, self._training(folder, hours), self._params(len(chosen)),
                          own=(own,))
        except TooShort as error:
            raise InputError(f"a budget of {self.hours:g} h leaves too little time to learn on "
                             f"this machine: give --budget {error.enough / share:.2g} or more, or "
                             "fewer --scans") from None
        if ended is not None and ended.progress.stopped:
            raise KeyboardInterrupt
        if not taught.is_file():
            raise InputError(f"a budget of {self.hours:g} h was spent before the first step, as "
                             "this machine was slower than planned; --resume goes on with what is "
                             "prepared")
        return taught

    def _training(self, folder: Path, hours: float | None = None) -> Asked:
        return Asked((SIM,), (SIM,), None, None, folder, True, self.best, self.device, self.jobs,
                     hours)

    def _params(self, count: int) -> Any:
        return training_params(self.header, self.params, count, self.height, self.out / SCANS)

    def _watch(self, path: Path, weights: Path) -> Watched:
        """How good weights are, from the file if it is known."""
        if path.is_file():
            return Watched(**json.loads(read_text(path, 10**6)))
        metrics = simulated_score(self.network, self._training(self.out), self._params(1),
                                  self.sensor, weights)
        held = [(seen, k) for seen in self.first_seen for k in seen.piece.held]
        held = [held[i] for i in np.unique(np.linspace(0, len(held) - 1, MOST_HELD).astype(int))]
        frames = [self.frames[seen.piece.numbers[k]] for seen, k in held]
        f1, found, kept = agreement_of(open_detector(weights, self.device), frames,
                                       [seen.labels[k] for seen, k in held], self.low, self.high)
        looker = Looker(self.opened(weights))
        looks = [looker(frame, np.eye(4)) for frame in track(frames, "judging all sources",
                                                             len(frames))]
        watched = Watched(
            metrics["score"], {name: value for name, value in metrics.items()
                               if name.endswith("_bev_relaxed") and np.isfinite(value)},
            f1, confirmed_share(looks, self.heard), found, kept)
        write_text(path, json.dumps(watched.json(), indent=1))
        errors.print(f"{weights}: simulated AP {watched.simulated:.1f}, agreement "
                     f"{watched.agreement:.2f}, confirmed {watched.confirmed:.2f}")
        return watched

    def _record(self) -> None:
        path = self.out / RECORD
        known = json.loads(read_text(path, 10**8))
        results = {"before": self.before and self.before.json(),
                   "rounds": [asdict(each) for each in self.rounds],
                   "recognised": self.recognised, "best": str(self.best), "objects": [
                       {"piece": seen.piece.name, "first": seen.piece.numbers[0], "objects": [
                           {"class": CLASSES[t.class_id], "state": v.state, "reason": v.reason,
                            "score": round(t.score, 3), "frames": t.frames.tolist()}
                           for t, v in zip(seen.tracks, seen.verdicts)]} for seen in self.seen]}
        write_text(path, json.dumps({**known, **results}, indent=1))


def counted(seen: Sequence[Seen]) -> dict[str, dict[str, int]]:
    """How many objects, by state and class."""
    pairs = [(v.state, CLASSES[t.class_id]) for each in seen
             for t, v in zip(each.tracks, each.verdicts)]
    return {state: {name: pairs.count((state, name)) for name in CLASSES
                    if (state, name) in pairs} for state in STATES}

"""A drive with its labels, and all that can be done to them: the server and the simulated annotator
both work through this."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.labels.exchange import export_labels, import_labels, recognise_format
from lidar_perception.runs.files import shorten_error
from lidar_perception.types import CLASSES, PEDESTRIAN, InputError
from lidar_studio import survey_cache
from lidar_studio.actions import (
    Action,
    apply,
    box_of,
    class_of,
    frame_of,
    motion_of,
    numbers,
    rounded,
    track_of,
)
from lidar_studio.drive import Drive
from lidar_studio.interpolation import Motion
from lidar_studio.journal import Journal, opened
from lidar_studio.labelled import digest_of, from_labels, joined, to_labels
from lidar_studio.proposing import Proposer, merged
from lidar_studio.snap import around_click, to_cluster, to_ground, to_size
from lidar_studio.state import (
    ACCEPTED,
    CLICK,
    KEY,
    REJECTED,
    Box,
    Change,
    State,
    Track,
    progress,
    track_to_json,
)

Array = np.ndarray[Any, Any]

NEARBY = 20  # frames before and after a click through which it is followed before it is answered
Listener = Callable[[dict[str, Any]], None]


class ImportedAlready(InputError):
    """The same labels are among those of the journal."""


class Session:
    """May be called from several threads. listeners: told of every action, as /api/events has
    it; busy: what goes on, as PROGRESS has it."""

    def __init__(self, drive: Drive, journal: Journal,
                 detector: DetectorChoice | None = DetectorChoice()) -> None:
        self.drive, self.journal, self.state = drive, journal, State()
        self.proposer = Proposer(drive, detector, journal.path.with_name(survey_cache.FOLDER))
        self.listeners: list[Listener] = []
        self.busy: dict[str, Any] | None = None
        self.was_proposed = any(line.get("do") == "propose" for line in journal.lines)
        self._end = self._next_end = threading.Event()  # of what goes on, of what waits for that
        self._beside: threading.Thread | None = None
        self._what = ""  # goes on there
        self._lock, self._exporting = threading.RLock(), threading.Lock()
        for line in journal.lines:
            self.state, _ = apply(self.state, line, drive.motion)
        journal.lines.clear()

    @property
    def motion(self) -> Motion:
        """Times, and poses as far as they are known."""
        return motion_of(self.state, self.drive.motion)

    def do(self, action: Mapping[str, Any], by: str = "") -> int:
        """Do an action of a page; its number. InputError where it cannot be done, or not be
        written: then nothing has changed."""
        if action.get("do") in ("propose", "cancel"):
            return self.prepare(by, True) if action["do"] == "propose" else self.cancel()
        with self._lock:
            seq, name = self._record(self._computed(_asked(action)), by), action.get("do")
            # What was made while a click was followed is undone to the track of before; one that
            # was rejected meanwhile was followed no further.
            again = name in ("undo", "redo", "accept", "reopen") and not self._what
            if (name == "seed" or again) and self._waiting():
                self._start("following", lambda: self._follow(by, None if again else seq))
        return seq

    def cancel(self) -> int:
        """End what goes on; the number of the last action."""
        self._end.set()
        self._next_end.set()
        return self.state.seq

    def prepare(self, by: str = "", anew: bool = False) -> int:
        """Begin to look at the drive, beside the page, and write down proposals where there were
        none yet, or anew; the number of the last action. InputError while that goes on."""
        with self._lock:
            if self._what == "proposing":
                raise InputError("proposals are being made already")
            self._start("proposing", lambda: self.propose(by, anew=anew or not self.was_proposed,
                                                          asked=anew))
        return self.state.seq

    def _start(self, what: str, work: Callable[[], None]) -> None:
        """Do what takes long in a thread of its own; what went on before ends."""
        self.cancel()
        before, own, self._what = self._beside, threading.Event(), what
        self._next_end = own

        def beside() -> None:
            if before is not None:
                before.join()
            self.busy = {"what": what, "done": 0, "of": len(self.drive.frames)}
            self._end = own  # set where it was cancelled while it waited
            try:
                work()
            except Exception as error:  # of a thread nobody waits for: the page is told
                self.tell({"error": str(error) if isinstance(error, InputError) else
                           f"no proposals: {type(error).__name__}: {shorten_error(error)}"})
            finally:
                self.busy = None
                with self._lock:
                    if self._beside is threading.current_thread():
                        self._what = ""
                self.tell({"progress": self.progress()})
        self._beside = threading.Thread(target=beside, daemon=True)
        self._beside.start()

    def wait(self) -> None:
        """Until what goes on beside is done."""
        if self._beside is not None:
            self._beside.join()

    def propose(self, by: str = "", here: bool = False,
                told: Callable[[int], object] = lambda count: None, anew: bool = True,
                asked: bool = False) -> None:
        """Look at the drive, in a process of its own or here, and write down the proposals, with
        anew=False only where a seed waits to be followed; nothing is written if it is cancelled.
        told: how many frames were looked at; asked: by a person, who can undo it. InputError where
        a frame or the weights cannot be read."""
        def done(count: int) -> bool:
            told(count)
            return self._done(count)
        self.proposer.remember()
        self._tell_problem()
        if self.proposer.looks is None:
            whole = self.proposer.survey(done, here)
            self._tell_problem()
            if not whole:
                return
        with self._lock:
            if not self.state.poses and (poses := self.proposer.poses()) is not None:
                self._record({"do": "poses", "poses": poses}, by)
        if anew or self._waiting():
            self._propose_all(by, None, asked)

    def _tell_problem(self) -> None:
        """What is wrong with what is kept of the survey, once."""
        if self.proposer.problem:
            self.tell({"error": self.proposer.problem})
            self.proposer.problem = ""

    def _done(self, count: int) -> bool:
        """So many frames of what goes on; whether to go on."""
        if self.busy is not None:
            self.busy = {**self.busy, "done": count}
            self.tell({"progress": self.progress()})
        return not self._end.is_set()

    def _propose_all(self, by: str, seed: int | None, asked: bool = False) -> None:
        """Follow everything through the whole drive, and write that down; with the number of the
        action that began it as one action, if it is the last. Others may be done meanwhile."""
        state = self.state
        found = self.proposer.proposals(state, self.motion, None, self._done)
        with self._lock:
            if found is None or self._end.is_set() or (seed is not None and not self._waiting()):
                return
            tracks, removed = merged(self.state, found, self.motion)
            # A seed is undone with all that came of it, but never with the first proposals.
            joins = seed == self.state.seq and self.was_proposed
            how = {} if asked else {"joins": True} if joins else {"beside": True}
            self._record({"do": "propose", **_made(tracks, removed), **how}, by)
            self.was_proposed = True

    def _follow(self, by: str, seed: int | None) -> None:
        with self._lock:
            waiting = self._waiting()
        if waiting:
            self._propose_all(by, seed)

    def _waiting(self) -> bool:
        """Whether there is a seed that is to be followed through the whole drive."""
        return any(t.nearby and t.placed for t in self.state.tracks.values())

    def _computed(self, action: Action) -> Action:
        """The action with what is computed for it, as the journal has it."""
        name = action.get("do")
        if name == "seed":
            return self._seeded(action)
        if name == "snap":
            return {**action, "box": rounded(self._snapped(action))}
        if name == "import":
            return self._imported(action)
        if name in ("accept", "reopen"):
            track = track_of(self.state, action.get("track"))
            clicked = track.source == CLICK and track.state == REJECTED  # it was a seed before
            if track.boxes and (clicked or (name == "accept"
                                            and track.class_name == CLASSES[PEDESTRIAN])):
                return {**action, "seed": track.nearest_frame()}
        return action

    def _imported(self, action: Action) -> Action:
        path, named = action.get("path"), action.get("format") or ""
        if not isinstance(path, str) or not isinstance(named, str):
            raise InputError("an import needs the path of labels, and may name their format")
        labels = import_labels(Path(path), named or recognise_format(Path(path)), self.drive.frames)
        tracks, kept = from_labels(labels, self.state.next_id)
        before = self.state.kept
        digest, done = digest_of(tracks, kept), before.get("imports", [])
        if digest in done:
            raise ImportedAlready(f"the labels of {path} were imported already; nothing was done")
        return {**action, "tracks": [track_to_json(t) for t in tracks],
                "kept": {**joined(before, kept), "imports": [*done, digest]}}

    def export(self, named: str, out: str, force: bool = False) -> dict[str, Any]:
        """Write the accepted tracks in a format of exchange.FORMATS, to a path or, by its name,
        into the journal's folder; as /api/export has it. InputError where that cannot be."""
        path = Path(out).expanduser()
        if not out or ".." in path.parts:
            raise InputError(f"{out!r} is no name for an export; give one without '..'")
        path = self.journal.path.parent / path
        if path.resolve() == self.journal.path.resolve():
            raise InputError(f"{path} is the journal of these labels; give another name")
        with self._exporting:  # a button may be pressed twice
            written = export_labels(to_labels(self.state, self.drive.frames), named, path,
                                    self.drive.frames, force)
        nearby = [t.id for t in self.state.tracks.values() if t.nearby and t.placed]
        return {"path": str(written.path), "boxes": written.boxes, "frames": written.frames,
                "left_out": [*written.left_out, *(
                    [f"the rest of tracks that are being followed: {nearby}"] if nearby else [])]}

    def _seeded(self, action: Action) -> Action:
        frame, named = frame_of(action, self.drive.motion), class_of(action)
        click = np.array(numbers(action, "xyz", 3))
        box = around_click(self.drive.clouds(frame), click, named)
        box = self.proposer.detected(frame, box, named)
        track = Track(self.state.next_id, named, ACCEPTED, 1.0, CLICK,
                      {frame: Box(tuple(rounded(box)), KEY)})
        alone = {**action, "track": track.id, "tracks": [track_to_json(track)]}
        if self.proposer.looks is None:
            return alone
        state = apply(self.state, alone, self.drive.motion)[0]
        motion, count = motion_of(state, self.drive.motion), len(self.drive.frames)
        nearby = range(max(frame - NEARBY, 0), min(frame + NEARBY + 1, count))
        some = count > 2 * NEARBY
        found = self.proposer.proposals(state, motion, nearby if some else None)
        tracks, removed = merged(state, found or [], motion)
        if some:  # what is known of the frames around says nothing of what is there already
            tracks = [t for t in tracks if t.id == track.id or t.id not in state.tracks]
            removed = []
        own = next((t for t in tracks if t.id == track.id), track)
        tracks = [t for t in tracks if t is not own] + [replace(own, nearby=some)]
        return {**alone, **_made(tracks, removed)}

    def _snapped(self, action: Action) -> Array:
        track, frame = track_of(self.state, action.get("track")), frame_of(action,
                                                                          self.drive.motion)
        box = np.array(box_of(track, frame).values)
        if action.get("to") == "size":
            others = [b.values[3:6] for f, b in track.boxes.items() if f != frame]
            keys = [b.values[3:6] for f, b in track.boxes.items() if f != frame and b.kind == KEY]
            return to_size(box, np.median(keys or others or [tuple(box[3:6])], axis=0))
        if action.get("to") not in ("cluster", "ground"):
            raise InputError("a box snaps to cluster, ground or size")
        scan = self.drive.clouds(frame)
        return to_cluster(scan, box) if action["to"] == "cluster" else to_ground(scan, box)

    def _record(self, action: Action, by: str) -> int:
        after, change = apply(self.state, action, self.drive.motion)
        self.journal.append({"seq": after.seq, "time": datetime.now(UTC).isoformat(), "by": by,
                             **action})
        self.state = after
        self._tell(action, change, by)
        return after.seq

    def _tell(self, action: Action, change: Change, by: str) -> None:
        tracks = [track_to_json(track) for _, track in change.tracks.values() if track]
        removed = [n for n, (_, track) in change.tracks.items() if track is None]
        named = {k: v for k, v in action.items() if k not in ("tracks", "removed", "poses", "kept")
                 or action["do"] == "merge"}
        self.tell({"seq": self.state.seq, "by": by, "action": named, "tracks": tracks,
                   "removed": removed, **self.summary()})

    def tell(self, event: dict[str, Any]) -> None:
        """All listeners."""
        for listener in list(self.listeners):
            listener(event)

    def progress(self) -> dict[str, Any]:
        """How far the work is, and what goes on."""
        return {**progress(self.state, len(self.drive.frames)), "busy": self.busy}

    def summary(self) -> dict[str, Any]:
        """All but the tracks, as the page has it."""
        state = self.state
        return {"checked": sorted(state.checked), "seeds": [list(s) for s in state.seeds],
                "can_undo": state.done is not None, "can_redo": state.undone is not None,
                "progress": self.progress()}

    def everything(self) -> dict[str, Any]:
        """As /api/state has it."""
        with self._lock:
            return {"seq": self.state.seq, **self.summary(),
                    "tracks": [track_to_json(t) for t in self.state.tracks.values()]}


def _made(tracks: list[Track], removed: list[int]) -> dict[str, Any]:
    return {"tracks": [track_to_json(t) for t in tracks], "removed": removed}


def _asked(action: Mapping[str, Any]) -> Action:
    """What a page may say of an action; what is computed for it, it may not."""
    if action.get("do") == "poses":
        raise InputError("poses come from the drive")
    computed = {"seed": ("track", "tracks", "removed"), "propose": ("tracks", "removed"),
                "import": ("tracks", "removed", "kept"),
                "accept": ("seed",), "reopen": ("seed",), "snap": ("box",)}
    unwanted = ("seq", "time", "by", "joins", "beside", *computed.get(str(action.get("do")), ()))
    return {k: v for k, v in action.items() if k not in unwanted}


@contextmanager
def session(drive: Drive, folder: Path,
            detector: DetectorChoice | None = DetectorChoice()) -> Iterator[Session]:
    """The labels of a drive in a folder, gone on with from where they were left. InputError for the
    journal of another drive, and while another process has it."""
    with opened(folder, drive.known_by) as journal:
        made = Session(drive, journal, detector)
        made.proposer.remember()
        try:
            yield made
        finally:
            made.cancel()

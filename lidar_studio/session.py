"""A labelling session: the labels of a drive, and the actions of its pages."""

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
    add_seed,
    apply,
    convert_tracks,
    require_class_name,
    require_frame,
    require_numbers,
    require_track,
    round_box,
    strip_computed,
    with_scan_poses,
)
from lidar_studio.drive import Drive
from lidar_studio.interpolation import Motion
from lidar_studio.journal import Journal, open_journal
from lidar_studio.label_conversion import compute_digest, join_extras, to_labels, to_tracks
from lidar_studio.proposer import Proposer, merge_proposals
from lidar_studio.snap import fit_clicked_box, snap_box
from lidar_studio.state import (
    ACCEPTED,
    CLICK,
    KEY,
    REJECTED,
    Box,
    Change,
    State,
    Track,
    count_progress,
    track_from_json,
    track_to_json,
)

Array = np.ndarray[Any, Any]

NEARBY_FRAMES = 20  # number of frames on each side of a click that are tracked immediately
Listener = Callable[[dict[str, Any]], None]


class AlreadyImportedError(InputError):
    """The journal already contains the same imported labels."""


class Session:
    """A labelling session; thread-safe.

    listeners: called with every event of /api/events.
    busy: progress of the background task, for the page; None without a task.
    """

    def __init__(self, drive: Drive, journal: Journal, detector: DetectorChoice | None = DetectorChoice()) -> None:
        self.drive, self.journal, self.state = drive, journal, State()
        self.proposer = Proposer(drive, detector, journal.path.with_name(survey_cache.FOLDER))
        self.listeners: list[Listener] = []
        self.busy: dict[str, Any] | None = None
        self.has_proposals = any(line.get("do") == "propose" for line in journal.lines)
        # Cancel events of the running task, and of the next one, which waits for it to end.
        self._cancelled = self._next_cancelled = threading.Event()
        self._worker: threading.Thread | None = None
        self._task = ""  # name of the worker's task, "" once it has ended
        self._lock, self._exporting = threading.RLock(), threading.Lock()
        for line in journal.lines:
            self.state, _ = apply(self.state, convert_tracks(line, track_from_json), drive.motion)
        journal.lines.clear()

    @property
    def motion(self) -> Motion:
        """Times of the frames, and sensor poses if known."""
        return with_scan_poses(self.state, self.drive.motion)

    def do(self, action: Mapping[str, Any], page_id: str = "") -> int:
        """Execute an action of a page and return its number.

        Raises:
            InputError: the action is invalid or cannot be written; the labels are unchanged.
        """
        if action.get("do") in ("propose", "cancel"):
            return self.start_proposals(page_id, True) if action["do"] == "propose" else self.cancel()
        with self._lock:
            seq = self._record(self._complete(strip_computed(action)), page_id)
            name = action.get("do")
            # Undo may restore a track from before its tracking ended, and rejected clicks are not
            # tracked. So a click may have to be tracked after these actions.
            resumes = name in ("undo", "redo", "accept", "reopen") and not self._task
            if (name == "seed" or resumes) and self._has_waiting_clicks():
                self._start("following", lambda: self._track_clicks(page_id, None if resumes else seq))
        return seq

    def cancel(self) -> int:
        """Cancel the background task; return the number of the last action."""
        self._cancelled.set()
        self._next_cancelled.set()
        return self.state.seq

    def start_proposals(self, page_id: str = "", again: bool = False) -> int:
        """Survey the drive in the background, and propose tracks if there are no proposals yet.

        Args:
            again: a person requested new proposals.

        Returns:
            The number of the last action.

        Raises:
            InputError: proposals are already being made.
        """
        with self._lock:
            if self._task == "proposing":
                raise InputError("proposals are already being made")
            self._start(
                "proposing", lambda: self.propose(page_id, again=again or not self.has_proposals, by_person=again)
            )
        return self.state.seq

    def _start(self, task: str, run_task: Callable[[], None]) -> None:
        """Cancel the previous task and run a new one in a thread."""
        self.cancel()
        previous, cancelled, self._task = self._worker, threading.Event(), task
        self._next_cancelled = cancelled

        def run() -> None:
            if previous is not None:
                previous.join()
            self.busy = {"what": task, "done": 0, "of": len(self.drive.frames)}
            self._cancelled = cancelled  # may already be set
            try:
                run_task()
            except Exception as error:  # shown on the page, because nobody joins this thread
                is_known = isinstance(error, InputError)
                reason = f"no proposals: {type(error).__name__}: {shorten_error(error)}"
                self.notify({"error": str(error) if is_known else reason})
            finally:
                self.busy = None
                with self._lock:
                    if self._worker is threading.current_thread():
                        self._task = ""
                self.notify({"progress": self.get_progress()})

        self._worker = threading.Thread(target=run, daemon=True)
        self._worker.start()

    def wait(self) -> None:
        """Wait for the background task to end."""
        if self._worker is not None:
            self._worker.join()

    def propose(self, page_id: str = "", again: bool = True, by_person: bool = False) -> None:
        """Survey the drive if necessary, and record proposals unless cancelled.

        Args:
            again: if False, make proposals only when a click has not been tracked yet.
            by_person: a person requested the proposals and can undo them.

        Raises:
            InputError: a frame or the weights cannot be read.
        """
        self.proposer.load_cached()
        self._report_problem()
        if self.proposer.surveys is None:
            complete = self.proposer.run_survey(self._report_progress)
            self._report_problem()
            if not complete:
                return
        with self._lock:
            if not self.state.poses and (poses := self.proposer.collect_scan_poses()) is not None:
                self._record({"do": "poses", "poses": poses}, page_id)
        if again or self._has_waiting_clicks():
            self._propose_all(page_id, None, by_person)

    def _report_problem(self) -> None:
        if self.proposer.problem:
            self.notify({"error": self.proposer.problem})
            self.proposer.problem = ""

    def _report_progress(self, count: int) -> bool:
        """Report the number of finished frames. Return False to cancel the task."""
        if self.busy is not None:
            self.busy = {**self.busy, "done": count}
            self.notify({"progress": self.get_progress()})
        return not self._cancelled.is_set()

    def _propose_all(self, page_id: str, seed: int | None, by_person: bool = False) -> None:
        """Make proposals for the whole drive and record them.

        Other actions may be recorded in the meantime. If the last action is still number `seed`,
        the proposals become part of it.
        """
        state = self.state
        proposals = self.proposer.make_proposals(state, self.motion, None, self._report_progress)
        with self._lock:
            if proposals is None or self._cancelled.is_set() or (seed is not None and not self._has_waiting_clicks()):
                return
            tracks, removed = merge_proposals(self.state, proposals, self.motion)
            # Undoing a seed also undoes its proposals, but never the first proposals of a drive.
            joins = seed == self.state.seq and self.has_proposals
            undo = {} if by_person else {"joins": True} if joins else {"beside": True}
            self._record({"do": "propose", "tracks": tracks, "removed": removed, **undo}, page_id)
            self.has_proposals = True

    def _track_clicks(self, page_id: str, seed: int | None) -> None:
        with self._lock:
            waiting = self._has_waiting_clicks()
        if waiting:
            self._propose_all(page_id, seed)

    def _has_waiting_clicks(self) -> bool:
        return any(t.nearby and t.awaits_tracking for t in self.state.tracks.values())

    def _complete(self, action: Action) -> Action:
        """Add the computed fields to an action."""
        name = action.get("do")
        if name == "seed":
            return self._complete_seed(action)
        if name == "snap":
            return {**action, "box": round_box(snap_box(action, self.state, self.drive))}
        if name == "import":
            return self._complete_import(action)
        if name in ("accept", "reopen"):
            track = require_track(self.state, action.get("track"))
            was_seed = track.source == CLICK and track.state == REJECTED
            if track.boxes and (was_seed or (name == "accept" and track.class_name == CLASSES[PEDESTRIAN])):
                return {**action, "seed": track.find_nearest_frame()}
        return action

    def _complete_import(self, action: Action) -> Action:
        path, name = action.get("path"), action.get("format") or ""
        if not isinstance(path, str) or not isinstance(name, str):
            raise InputError("an import needs the path of a label file or folder, and optionally a format, as text")
        labels = import_labels(Path(path), name or recognise_format(Path(path)), self.drive.frames)
        tracks, preserved = to_tracks(labels, self.state.next_id)
        earlier = self.state.preserved
        digest, imports = compute_digest(tracks, preserved), earlier.get("imports", [])
        if digest in imports:
            raise AlreadyImportedError(f"the labels in {path} were already imported; nothing was done")
        return {**action, "tracks": tracks, "kept": {**join_extras(earlier, preserved), "imports": [*imports, digest]}}

    def export(self, format_name: str, out: str, force: bool = False) -> dict[str, Any]:
        """Export the accepted tracks.

        Args:
            format_name: a key of exchange.FORMATS.
            out: path, relative to the journal's folder.
            force: replace existing files.

        Returns:
            The JSON object of /api/export: path, boxes, frames, left_out.

        Raises:
            InputError: the labels cannot be written there.
        """
        path = Path(out).expanduser()
        if not out or ".." in path.parts:
            raise InputError(f"{out!r} is not a valid name for an export; give one without '..'")
        path = self.journal.path.parent / path
        if path.resolve() == self.journal.path.resolve():
            raise InputError(f"{path} is the journal of these labels; give another name")
        with self._exporting:  # the user may press the button twice
            written = export_labels(
                to_labels(self.state, self.drive.frames), format_name, path, self.drive.frames, force
            )
        nearby = [t.id for t in self.state.tracks.values() if t.nearby and t.awaits_tracking]
        return {
            "path": str(written.path),
            "boxes": written.boxes,
            "frames": written.frames,
            "left_out": [
                *written.left_out,
                *([f"later boxes of tracks that are still being tracked: {nearby}"] if nearby else []),
            ],
        }

    def _complete_seed(self, action: Action) -> Action:
        frame, class_name = require_frame(action, self.drive.motion), require_class_name(action)
        click = np.array(require_numbers(action, "xyz", 3))
        box = fit_clicked_box(self.drive.load_scan(frame), click, class_name)
        box = self.proposer.refine_with_detection(frame, box, class_name)
        track = Track(self.state.next_id, class_name, ACCEPTED, 1.0, CLICK, {frame: Box(tuple(round_box(box)), KEY)})
        action = {**action, "track": track.id}
        if self.proposer.surveys is None:
            return {**action, "tracks": [track]}
        state = replace(
            self.state,
            tracks={**self.state.tracks, track.id: track},
            seeds=add_seed(self.state.seeds, frame, track.id),
            next_id=track.id + 1,
        )
        count = len(self.drive.frames)
        nearby = range(max(frame - NEARBY_FRAMES, 0), min(frame + NEARBY_FRAMES + 1, count))
        is_long = count > 2 * NEARBY_FRAMES
        proposals = self.proposer.make_proposals(state, self.motion, nearby if is_long else None)
        tracks, removed = merge_proposals(state, proposals or [], self.motion)
        if is_long:  # proposals in nearby frames must not replace tracks of the whole drive
            tracks = [t for t in tracks if t.id == track.id or t.id not in state.tracks]
            removed = []
        clicked = next((t for t in tracks if t.id == track.id), track)
        tracks = [t for t in tracks if t is not clicked] + [replace(clicked, nearby=is_long)]
        return {**action, "tracks": tracks, "removed": removed}

    def _record(self, action: Action, page_id: str) -> int:
        """Apply an action, write it to the journal, and notify the listeners."""
        new_state, change = apply(self.state, action, self.drive.motion)
        encoded: dict[int, dict[str, Any]] = {}

        def encode(track: Track) -> dict[str, Any]:
            if track.id not in encoded:
                encoded[track.id] = track_to_json(track)
            return encoded[track.id]

        line = {"seq": new_state.seq, "time": datetime.now(UTC).isoformat(), "by": page_id}
        self.journal.append({**line, **convert_tracks(action, encode)})
        self.state = new_state
        self._notify_change(action, change, page_id, encode)
        return new_state.seq

    def _notify_change(
        self, action: Action, change: Change, page_id: str, encode: Callable[[Track], dict[str, Any]]
    ) -> None:
        tracks = [encode(track) for _, track in change.tracks.values() if track]
        removed = [n for n, (_, track) in change.tracks.items() if track is None]
        hidden = () if action["do"] == "merge" else ("tracks", "removed", "poses", "kept")
        public_action = {k: v for k, v in action.items() if k not in hidden}
        event = {"seq": self.state.seq, "by": page_id, "action": public_action, "tracks": tracks, "removed": removed}
        self.notify({**event, **self.summarize()})

    def notify(self, event: dict[str, Any]) -> None:
        """Send an event to all listeners."""
        for listener in list(self.listeners):
            listener(event)

    def get_progress(self) -> dict[str, Any]:
        """Return counts of tracks and frames, and the progress of the background task."""
        return {**count_progress(self.state, len(self.drive.frames)), "busy": self.busy}

    def summarize(self) -> dict[str, Any]:
        """Return the part of the state that every event contains: all but the tracks."""
        state = self.state
        return {
            "checked": sorted(state.checked),
            "seeds": [list(s) for s in state.seeds],
            "can_undo": state.undo_stack is not None,
            "can_redo": state.redo_stack is not None,
            "progress": self.get_progress(),
        }

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object of /api/state."""
        with self._lock:
            return {
                "seq": self.state.seq,
                **self.summarize(),
                "tracks": [track_to_json(t) for t in self.state.tracks.values()],
            }


@contextmanager
def open_session(drive: Drive, folder: Path, detector: DetectorChoice | None = DetectorChoice()) -> Iterator[Session]:
    """Open the labels of a drive that are stored in a folder, or start new ones.

    Raises:
        InputError: the journal belongs to another drive, or another process uses it.
    """
    with open_journal(folder, drive.journal_header) as journal:
        session = Session(drive, journal, detector)
        session.proposer.load_cached()
        try:
            yield session
        finally:
            session.cancel()

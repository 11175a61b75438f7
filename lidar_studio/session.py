"""A labelling session: the labels of a drive, and the actions sent by its browser pages."""

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
from lidar_studio.label_conversion import compute_digest, merge_preserved_fields, to_labels, to_tracks
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

NEARBY_FRAMES = 20  # frames on each side of a click in which the object is tracked immediately
Listener = Callable[[dict[str, Any]], None]


class AlreadyImportedError(InputError):
    """The same labels have already been imported into this journal."""


class Session:
    """Thread-safe labelling session.

    Attributes:
        listeners: Functions called with every event of /api/events.
        busy: Progress of the background task, or None if no task is running.
    """

    def __init__(self, drive: Drive, journal: Journal, detector: DetectorChoice | None = DetectorChoice()) -> None:
        self.drive, self.journal, self.state = drive, journal, State()
        self.proposer = Proposer(drive, detector, journal.path.with_name(survey_cache.FOLDER))
        self.listeners: list[Listener] = []
        self.busy: dict[str, Any] | None = None
        self.has_proposals = any(line.get("do") == "propose" for line in journal.lines)
        # Cancellation of the running task, and of the next task, which waits for the running one to end.
        self._cancel_event = self._next_cancel_event = threading.Event()
        self._worker: threading.Thread | None = None
        self._task = ""  # name of the worker's task, "" once it has ended
        self._lock, self._export_lock = threading.RLock(), threading.Lock()
        for line in journal.lines:
            self.state, _ = apply(self.state, convert_tracks(line, track_from_json), drive.motion)
        journal.lines.clear()

    @property
    def motion(self) -> Motion:
        """Times of the frames, and the sensor poses if they are known."""
        return with_scan_poses(self.state, self.drive.motion)

    def execute(self, action: Mapping[str, Any], page_id: str = "") -> int:
        """Execute an action sent by a page and return its number.

        Raises:
            InputError: The action is invalid or cannot be saved. The labels are unchanged.
        """
        if action.get("do") in ("propose", "cancel"):
            return self.start_proposals(page_id, True) if action["do"] == "propose" else self.cancel()
        with self._lock:
            seq = self._record(self._add_computed_fields(strip_computed(action)), page_id)
            name = action.get("do")
            # Undo may restore a clicked track that was not fully tracked yet, and rejected tracks are not
            # tracked at all. So these actions may leave a clicked object that still has to be tracked.
            restores_tracks = name in ("undo", "redo", "accept", "reopen") and not self._task
            if (name == "seed" or restores_tracks) and self._has_waiting_clicks():
                self._start(
                    "tracking clicked objects", lambda: self._track_clicks(page_id, None if restores_tracks else seq)
                )
        return seq

    def cancel(self) -> int:
        """Cancel the background task; return the number of the last action."""
        self._cancel_event.set()
        self._next_cancel_event.set()
        return self.state.seq

    def start_proposals(self, page_id: str = "", is_requested: bool = False) -> int:
        """Survey the drive in the background, and propose tracks if there are no proposals yet.

        Args:
            is_requested: True if a person requested new proposals.

        Returns:
            The number of the last action.

        Raises:
            InputError: Proposals are already being computed.
        """
        with self._lock:
            if self._task == "proposing tracks":
                raise InputError("proposals are already being computed; wait until they are finished, or cancel them")
            self._start(
                "proposing tracks",
                lambda: self.propose(page_id, recompute=is_requested or not self.has_proposals, by_person=is_requested),
            )
        return self.state.seq

    def _start(self, task: str, run_task: Callable[[], None]) -> None:
        """Cancel the previous task and run a new task in a thread."""
        self.cancel()
        previous_worker, cancel_event, self._task = self._worker, threading.Event(), task
        self._next_cancel_event = cancel_event

        def run() -> None:
            if previous_worker is not None:
                previous_worker.join()
            self.busy = {"what": task, "done": 0, "of": len(self.drive.frames)}
            self._cancel_event = cancel_event  # may already be set
            try:
                run_task()
            except InputError as error:
                self.notify({"error": str(error)})
            except Exception as error:  # show it on the page, because nobody joins this thread
                self.notify({"error": f"cannot compute proposals: {type(error).__name__}: {shorten_error(error)}"})
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

    def propose(self, page_id: str = "", recompute: bool = True, by_person: bool = False) -> None:
        """Survey the drive if necessary, and record proposals unless the task is cancelled.

        Args:
            recompute: If False, compute proposals only if a clicked object still has to be tracked.
            by_person: True if a person requested the proposals and can undo them.

        Raises:
            InputError: A frame or the weights cannot be read.
        """
        self.proposer.load_cached()
        self._report_problem()
        if self.proposer.surveys is None:
            is_complete = self.proposer.run_survey(self._report_progress)
            self._report_problem()
            if not is_complete:
                return
        with self._lock:
            if not self.state.poses and (poses := self.proposer.collect_scan_poses()) is not None:
                self._record({"do": "poses", "poses": poses}, page_id)
        if recompute or self._has_waiting_clicks():
            self._propose_all(page_id, None, by_person)

    def _report_problem(self) -> None:
        if self.proposer.problem:
            self.notify({"error": self.proposer.problem})
            self.proposer.problem = ""

    def _report_progress(self, count: int) -> bool:
        """Report the number of finished frames; return False if the task has been cancelled."""
        if self.busy is not None:
            self.busy = {**self.busy, "done": count}
            self.notify({"progress": self.get_progress()})
        return not self._cancel_event.is_set()

    def _propose_all(self, page_id: str, seed: int | None, by_person: bool = False) -> None:
        """Compute proposals for the whole drive and record them.

        Other actions may be recorded in the meantime. If the last action is still number `seed`, the
        proposals become part of that action, so that both are undone together.
        """
        state = self.state
        proposals = self.proposer.make_proposals(state, self.motion, None, self._report_progress)
        with self._lock:
            if (
                proposals is None
                or self._cancel_event.is_set()
                or (seed is not None and not self._has_waiting_clicks())
            ):
                return
            tracks, removed_ids = merge_proposals(self.state, proposals, self.motion)
            # Undoing a click also undoes its proposals, but never the first proposals of a drive.
            belongs_to_seed = seed == self.state.seq and self.has_proposals
            undo_mode = {} if by_person else {"joins": True} if belongs_to_seed else {"beside": True}
            self._record({"do": "propose", "tracks": tracks, "removed": removed_ids, **undo_mode}, page_id)
            self.has_proposals = True

    def _track_clicks(self, page_id: str, seed: int | None) -> None:
        with self._lock:
            has_waiting_clicks = self._has_waiting_clicks()
        if has_waiting_clicks:
            self._propose_all(page_id, seed)

    def _has_waiting_clicks(self) -> bool:
        return any(t.is_partly_tracked and t.awaits_tracking for t in self.state.tracks.values())

    def _add_computed_fields(self, action: Action) -> Action:
        """Return an action with the fields that the server computes."""
        name = action.get("do")
        if name == "seed":
            return self._add_seed_tracks(action)
        if name == "snap":
            return {**action, "box": round_box(snap_box(action, self.state, self.drive))}
        if name == "import":
            return self._add_imported_tracks(action)
        if name in ("accept", "reopen"):
            track = require_track(self.state, action.get("track"))
            was_seed = track.source == CLICK and track.state == REJECTED
            if track.boxes and (was_seed or (name == "accept" and track.class_name == CLASSES[PEDESTRIAN])):
                return {**action, "seed": track.find_nearest_frame()}
        return action

    def _add_imported_tracks(self, action: Action) -> Action:
        path, name = action.get("path"), action.get("format") or ""
        if not isinstance(path, str) or not isinstance(name, str):
            raise InputError(
                "an import requires `path` (a label file or folder); `format` is optional; both are strings"
            )
        labels = import_labels(Path(path), name or recognise_format(Path(path)), self.drive.frames)
        tracks, new_fields = to_tracks(labels, self.state.next_id)
        old_fields = self.state.preserved_fields
        digest, imports = compute_digest(tracks, new_fields), old_fields.get("imports", [])
        if digest in imports:
            raise AlreadyImportedError(f"the labels in {path} were already imported; nothing was changed")
        preserved_fields = {**merge_preserved_fields(old_fields, new_fields), "imports": [*imports, digest]}
        return {**action, "tracks": tracks, "kept": preserved_fields}

    def export(self, format_name: str, out: str, force: bool = False) -> dict[str, Any]:
        """Export the accepted tracks.

        Args:
            format_name: Key of exchange.FORMATS.
            out: Output path, relative to the journal's folder.
            force: True to replace existing files.

        Returns:
            The JSON object of /api/export with path, boxes, frames and left_out.

        Raises:
            InputError: The labels cannot be written to this path.
        """
        path = Path(out).expanduser()
        if not out or ".." in path.parts:
            raise InputError(f"invalid export path {out!r}: it must not be empty or contain '..'")
        path = self.journal.path.parent / path
        if path.resolve() == self.journal.path.resolve():
            raise InputError(f"cannot export to {path}: this is the journal of these labels; choose another name")
        with self._export_lock:  # the user may press the button twice
            result = export_labels(
                to_labels(self.state, self.drive.frames), format_name, path, self.drive.frames, force
            )
        partial_ids = [t.id for t in self.state.tracks.values() if t.is_partly_tracked and t.awaits_tracking]
        left_out = [*result.left_out]
        if partial_ids:
            left_out.append(f"boxes far from the click of tracks that are still being computed: {partial_ids}")
        return {"path": str(result.path), "boxes": result.boxes, "frames": result.frames, "left_out": left_out}

    def _add_seed_tracks(self, action: Action) -> Action:
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
        nearby_frames = range(max(frame - NEARBY_FRAMES, 0), min(frame + NEARBY_FRAMES + 1, count))
        is_long = count > 2 * NEARBY_FRAMES
        proposals = self.proposer.make_proposals(state, self.motion, nearby_frames if is_long else None)
        tracks, removed_ids = merge_proposals(state, proposals or [], self.motion)
        if is_long:  # proposals in nearby frames must not replace tracks of the whole drive
            tracks = [t for t in tracks if t.id == track.id or t.id not in state.tracks]
            removed_ids = []
        clicked_track = next((t for t in tracks if t.id == track.id), track)
        tracks = [t for t in tracks if t is not clicked_track] + [replace(clicked_track, is_partly_tracked=is_long)]
        return {**action, "tracks": tracks, "removed": removed_ids}

    def _record(self, action: Action, page_id: str) -> int:
        """Apply an action, write it to the journal, notify the listeners, and return its number."""
        new_state, change = apply(self.state, action, self.drive.motion)
        encoded_tracks: dict[int, dict[str, Any]] = {}

        def encode(track: Track) -> dict[str, Any]:
            if track.id not in encoded_tracks:
                encoded_tracks[track.id] = track_to_json(track)
            return encoded_tracks[track.id]

        line = {"seq": new_state.seq, "time": datetime.now(UTC).isoformat(), "by": page_id}
        self.journal.append({**line, **convert_tracks(action, encode)})
        self.state = new_state
        self._notify_change(action, change, page_id, encode)
        return new_state.seq

    def _notify_change(
        self, action: Action, change: Change, page_id: str, encode: Callable[[Track], dict[str, Any]]
    ) -> None:
        tracks = [encode(track) for _, track in change.tracks.values() if track]
        removed_ids = [n for n, (_, track) in change.tracks.items() if track is None]
        hidden_fields = () if action["do"] == "merge" else ("tracks", "removed", "poses", "kept")
        public_action = {k: v for k, v in action.items() if k not in hidden_fields}
        event = {
            "seq": self.state.seq,
            "by": page_id,
            "action": public_action,
            "tracks": tracks,
            "removed": removed_ids,
        }
        self.notify({**event, **self.summarize()})

    def notify(self, event: dict[str, Any]) -> None:
        """Send an event to all listeners."""
        for listener in list(self.listeners):
            listener(event)

    def get_progress(self) -> dict[str, Any]:
        """Return the numbers of tracks and frames, and the progress of the background task."""
        return {**count_progress(self.state, len(self.drive.frames)), "busy": self.busy}

    def summarize(self) -> dict[str, Any]:
        """Return the part of the state that every event contains, which is all but the tracks."""
        state = self.state
        return {
            "checked": sorted(state.checked_frames),
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
    """Open the labelling session stored in a folder, or start a new one.

    Raises:
        InputError: The journal belongs to another drive, or another process uses it.
    """
    with open_journal(folder, drive.journal_header) as journal:
        session = Session(drive, journal, detector)
        session.proposer.load_cached()
        try:
            yield session
        finally:
            session.cancel()

"""A drive with its labels, and all that can be done to them: the server and the simulated annotator
both work through this."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.labeling.actions import (
    Action,
    apply,
    box_of,
    class_of,
    frame_of,
    numbers,
    rounded,
    track_of,
)
from lidar_perception.labeling.drive import Drive
from lidar_perception.labeling.journal import Journal, header, opened
from lidar_perception.labeling.snap import around_click, to_cluster, to_ground, to_size
from lidar_perception.labeling.state import (
    ACCEPTED,
    KEY,
    Box,
    Change,
    State,
    Track,
    progress,
    track_to_json,
)
from lidar_perception.types import InputError

Array = np.ndarray[Any, Any]

Listener = Callable[[dict[str, Any]], None]


class Session:
    """May be called from several threads. listeners: told of every action, as /api/events has
    it."""

    def __init__(self, drive: Drive, journal: Journal) -> None:
        self.drive, self.journal, self.state = drive, journal, State()
        self.listeners: list[Listener] = []
        self.busy: dict[str, Any] | None = None
        self._lock = threading.RLock()
        for line in journal.lines:
            self.state, _ = apply(self.state, line, drive.motion)
        journal.lines.clear()

    def do(self, action: Mapping[str, Any], by: str = "") -> int:
        """Do an action of a page; its number. InputError where it cannot be done, or not be
        written: then nothing has changed."""
        with self._lock:
            return self._record(self._computed(_asked(action)), by)

    def _computed(self, action: Action) -> Action:
        """The action with what is computed for it, as the journal has it."""
        name, motion = action.get("do"), self.drive.motion
        if name == "seed":
            frame, named = frame_of(action, motion), class_of(action)
            click = np.array(numbers(action, "xyz", 3))
            box = around_click(self.drive.clouds(frame), click, named)
            track = Track(self.state.next_id, named, ACCEPTED, 1.0, "click",
                          {frame: Box(tuple(rounded(box)), KEY)})
            return {**action, "track": track.id, "tracks": [track_to_json(track)]}
        if name == "snap":
            return {**action, "box": rounded(self._snapped(action))}
        return action

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
        named = {k: v for k, v in action.items() if k not in ("tracks", "removed")
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


def _asked(action: Mapping[str, Any]) -> Action:
    """What a page may say of an action; what is computed for it, it may not."""
    computed = {"seed": ("track", "tracks", "removed"), "propose": ("tracks", "removed"),
                "import": ("tracks", "removed"), "accept": ("seed",), "snap": ("box",)}
    unwanted = ("seq", "time", "by", *computed.get(str(action.get("do")), ()))
    return {k: v for k, v in action.items() if k not in unwanted}


@contextmanager
def session(drive: Drive, folder: Path) -> Iterator[Session]:
    """The labels of a drive in a folder, gone on with from where they were left. InputError for the
    journal of another drive, and while another process has it."""
    head = header(drive.name, [f.name for f in drive.frames], [f.stamp_ns for f in drive.frames])
    with opened(folder, head) as journal:
        yield Session(drive, journal)

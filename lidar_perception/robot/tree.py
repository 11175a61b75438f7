"""The tree of coordinate frames over time, as /tf, /tf_static and odometry tell of it."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from lidar_perception.robot.poses import checked, interpolated, inverse
from lidar_perception.types import InputError

SECOND = 10**9
KEPT_NS = 10 * SECOND    # of each transform, as tf2 does
MAX_KEPT = 10_000        # of each transform, however often it comes
MAX_FRAMES = 10_000      # whoever makes a new name for every message does not fill the memory
JUMP_NS = SECOND         # a stamp so far before the last one is a bag that starts again
APART = 10.0             # seconds between a stamp and a transform: hardly a lag any more
CLOCKS = ("are they stamped by different clocks? Let the driver stamp clouds with the computer's "
          "time, synchronise the sensor (PTP), or set use_sim_time everywhere")


class Missing(InputError):
    """Two frames that are not connected, or not at that time. late: what is missing may still
    come, as only the newest transforms are from before that time."""

    def __init__(self, message: str, late: bool = False):
        super().__init__(message)
        self.late = late


class _Link:
    """A frame in its parent: one pose for ever, or those of the last seconds, or all of them."""

    def __init__(self, parent: str, static: bool, keeps_all: bool):
        self.parent, self.static, self.keeps_all = parent, static, keeps_all
        self.times: list[int] = []  # ns, ascending
        self.values: list[np.ndarray] = []  # (7,) translation and quaternion

    def add(self, stamp_ns: int, value: np.ndarray) -> None:
        if self.static:
            self.times, self.values = [stamp_ns], [value]
            return
        place = bisect_right(self.times, stamp_ns)  # a recording may go back far
        if place and self.times[place - 1] == stamp_ns:
            self.values[place - 1] = value
            return
        self.times.insert(place, stamp_ns)
        self.values.insert(place, value)
        if self.keeps_all:
            return
        old = 0
        while self.times[-1] - self.times[old] > KEPT_NS or len(self.times) - old > MAX_KEPT:
            old += 1
        if old > len(self.times) // 10:  # not with every message: that moves the whole list
            del self.times[:old], self.values[:old]

    def poses(self, at: np.ndarray, name: str, max_gap: float | None) -> np.ndarray:
        """(M, 4, 4) at times (M,) ns, as TransformTree.poses has it."""
        chosen = slice(0, 1) if self.static else self._around(int(at.min()), int(at.max()), name,
                                                              max_gap)
        values = np.array(self.values[chosen])
        return interpolated(np.array(self.times[chosen]), values[:, :3], values[:, 3:], at)

    def _around(self, begin: int, end: int, name: str, max_gap: float | None) -> slice:
        """What is needed from one time to another, ns. Missing where it is not there."""
        times, ago = self.times, (end - self.times[-1]) / SECOND
        if ago > 0 and (max_gap is None or ago > max_gap or len(times) == 1):
            why = (f"has its publisher stopped? If not, {CLOCKS}" if ago > APART else
                   "is its publisher late, or has it stopped?")
            raise Missing(f"the newest transform of {name} is {ago:.3f} s older than needed; {why}",
                          late=ago < 1.0)
        early = (times[0] - begin) / SECOND
        if early > 0 and (max_gap is None or early > max_gap or len(times) == 1):
            raise Missing(f"the oldest transform of {name} is {early:.3f} s newer than needed"
                          + (f"; {CLOCKS}" if early > APART else ""))
        first, last = bisect_right(times, begin) - 1, bisect_left(times, end)
        if early > 0:
            first, last = 0, max(last, 1)
        if ago > 0:
            first = min(first, len(times) - 2)
        chosen = slice(first, last + 1)
        gap = max((b - a for a, b in pairwise(times[chosen])), default=0) / SECOND
        if max_gap is not None and gap > max_gap:
            raise Missing(f"two transforms of {name} are {gap:.3f} s apart at the time needed")
        return chosen


class TransformTree:
    """Frames, each in its parent; poses are interpolated between the stamps, and extrapolated only
    for those who ask for it with max_gap.

    Transforms are kept for KEPT_NS. A stamp that is JUMP_NS or more before the last one of its
    frame is from a bag that starts again: all that moves is forgotten, what is fixed stays. With
    keeps_all, for what was recorded, nothing is forgotten.
    """

    def __init__(self, keeps_all: bool = False) -> None:
        self._links: dict[str, _Link] = {}  # by the frame that is the child
        self._keeps_all = keeps_all
        self.jumps = 0

    def set(self, parent: str, child: str, stamp_ns: int, translation: Sequence[float] | np.ndarray,
            quaternion: Sequence[float] | np.ndarray, static: bool = False) -> None:
        """The pose of child in parent: translation (3,) metres, quaternion (4,) [x y z w]. static:
        at any time. A child that gets another parent leaves the first. InputError for what is no
        pose, and for a frame in itself."""
        parent, child = parent.lstrip("/"), child.lstrip("/")
        name = f"'{parent}' -> '{child}'"
        if not parent or not child or parent == child:
            raise InputError(f"the transform {name} must be between two frames with names")
        value = np.concatenate(checked(translation, quaternion, f"the transform {name}"))
        link = self._links.get(child)
        if link is None and len(self._links) >= MAX_FRAMES:
            raise InputError(f"more than {MAX_FRAMES} frames in the tree; '{child}' is left out")
        if link is None or (link.parent, link.static) != (parent, static):
            link = self._links[child] = _Link(parent, static, self._keeps_all)
        back = bool(link.times) and stamp_ns <= link.times[-1] - JUMP_NS
        if back and not static and not self._keeps_all:
            self.forget()
            link = self._links[child] = _Link(parent, static, self._keeps_all)
        link.add(stamp_ns, value)

    def forget(self) -> None:
        """Forget all that moves, as when time went back."""
        self._links = {child: link for child, link in self._links.items() if link.static}
        self.jumps += 1

    def lookup(self, target: str, source: str, stamp_ns: int,
               max_gap: float | None = None) -> np.ndarray:
        """(4, 4): the pose of source in target at a time, which takes points of source to target.
        Missing where they are not connected at that time."""
        return self.poses(target, source, np.array([stamp_ns]), max_gap)[0]

    def poses(self, target: str, source: str, at: np.ndarray,
              max_gap: float | None = None) -> np.ndarray:
        """(M, 4, 4): as lookup, at times (M,) int ns, M > 0. With max_gap, seconds, what moves goes
        on after its newest transform as the last two do, and came to its oldest as the first two
        do, for so long, and is not known between two that are farther apart."""
        target, source = target.lstrip("/"), source.lstrip("/")
        up, down = self.chain(source), self.chain(target)
        common = next((frame for frame in up if frame in set(down)), None)
        if common is None:
            raise Missing(f"TF does not connect '{source}' with '{target}': "
                          f"{self._known(source, up)}, {self._known(target, down)}")
        return (inverse(self._along(down, common, at, max_gap))
                @ self._along(up, common, at, max_gap))

    def fixed(self, frame: str) -> bool:
        """Whether a frame does not move in its parent; True where it has none."""
        link = self._links.get(frame.lstrip("/"))
        return link is None or link.static

    def chain(self, frame: str) -> list[str]:
        """The frame, its parent, and so on to the root. Missing where they go round."""
        chain = [frame.lstrip("/")]
        while (link := self._links.get(chain[-1])) is not None:
            chain.append(link.parent)
            if link.parent in chain[:-1]:
                raise Missing(f"TF goes round in a circle: {' -> '.join(chain)}; two nodes publish "
                              "what contradicts")
        return chain

    def _known(self, frame: str, chain: list[str]) -> str:
        if len(chain) > 1:
            return f"'{frame}' is below '{chain[-1]}'"
        parents = {link.parent for link in self._links.values()}
        return f"'{frame}' is " + ("the root of a tree" if frame in parents else "not in TF")

    def _along(self, chain: list[str], common: str, at: np.ndarray,
               max_gap: float | None) -> np.ndarray:
        pose = np.broadcast_to(np.eye(4), (len(at), 4, 4))
        for child in chain[:chain.index(common)]:
            link = self._links[child]
            pose = link.poses(at, f"'{link.parent}' -> '{child}'", max_gap) @ pose
        return pose

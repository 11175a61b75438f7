"""Tree of coordinate frames over time, filled from /tf, /tf_static and odometry."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from lidar_perception.robot.poses import check_pose, interpolate_poses, invert_pose
from lidar_perception.types import InputError

SECOND_NS = 10**9
HISTORY_NS = 10 * SECOND_NS  # duration for which poses of a transform are stored, as in tf2
MAX_HISTORY = 10_000  # maximum number of stored poses of a transform
MAX_FRAMES = 10_000  # bounds the memory if a publisher makes a new name for every message
JUMP_NS = SECOND_NS  # a stamp this far before the last one means that a bag has restarted
MAX_LAG_S = 10.0  # a longer gap between a stamp and a transform means different clocks, not a lag
CLOCKS = (
    "do the stamps come from different clocks? Let the driver stamp clouds with the computer's "
    "time, synchronize the sensor (PTP), or set use_sim_time for all nodes"
)


class MissingTransform(InputError):
    """Two frames are not connected at the requested time.

    Attributes:
        late: True if the transform may still arrive, because only the newest one is missing.
    """

    def __init__(self, message: str, late: bool = False):
        super().__init__(message)
        self.late = late


class _Link:
    """Poses of a frame in its parent: a single static pose, or poses over time (all, or only recent ones)."""

    def __init__(self, parent: str, static: bool, keeps_all: bool):
        self.parent, self.static, self.keeps_all = parent, static, keeps_all
        self.times: list[int] = []  # ns, ascending
        self.values: list[np.ndarray] = []  # arrays (7,), translation and quaternion

    def add(self, stamp_ns: int, value: np.ndarray) -> None:
        if self.static:
            self.times, self.values = [stamp_ns], [value]
            return
        position = bisect_right(self.times, stamp_ns)  # a recording may go back in time
        if position and self.times[position - 1] == stamp_ns:
            self.values[position - 1] = value
            return
        self.times.insert(position, stamp_ns)
        self.values.insert(position, value)
        if self.keeps_all:
            return
        expired_count = 0
        while self.times[-1] - self.times[expired_count] > HISTORY_NS or len(self.times) - expired_count > MAX_HISTORY:
            expired_count += 1
        if expired_count > len(self.times) // 10:  # not for every message, because deleting moves the list
            del self.times[:expired_count], self.values[:expired_count]

    def interpolate(self, at: np.ndarray, name: str, max_gap: float | None) -> np.ndarray:
        """Return the poses (M, 4, 4) at times (M,) in ns; see TransformTree.lookup_many."""
        selection = slice(0, 1) if self.static else self._select(int(at.min()), int(at.max()), name, max_gap)
        values = np.array(self.values[selection])
        return interpolate_poses(np.array(self.times[selection]), values[:, :3], values[:, 3:], at)

    def _select(self, begin: int, end: int, name: str, max_gap: float | None) -> slice:
        """Select the poses needed to interpolate between the times `begin` and `end`, in ns.

        Raises:
            MissingTransform: The poses do not cover these times.
        """
        times, late_s = self.times, (end - self.times[-1]) / SECOND_NS
        if late_s > 0 and (max_gap is None or late_s > max_gap or len(times) == 1):
            hint = (
                f"has its publisher stopped? If not, {CLOCKS}"
                if late_s > MAX_LAG_S
                else "is its publisher late, or has it stopped?"
            )
            raise MissingTransform(
                f"the newest transform of {name} is {late_s:.3f} s older than needed; {hint}", late=late_s < 1.0
            )
        early_s = (times[0] - begin) / SECOND_NS
        if early_s > 0 and (max_gap is None or early_s > max_gap or len(times) == 1):
            raise MissingTransform(
                f"the oldest transform of {name} is {early_s:.3f} s newer than "
                "needed" + (f"; {CLOCKS}" if early_s > MAX_LAG_S else "")
            )
        first, last = bisect_right(times, begin) - 1, bisect_left(times, end)
        if early_s > 0:
            first, last = 0, max(last, 1)
        if late_s > 0:
            first = min(first, len(times) - 2)
        selection = slice(first, last + 1)
        gap = max((b - a for a, b in pairwise(times[selection])), default=0) / SECOND_NS
        if max_gap is not None and gap > max_gap:
            raise MissingTransform(f"two transforms of {name} are {gap:.3f} s apart at the requested time")
        return selection


class TransformTree:
    """Frames and their poses in their parent frames.

    Poses are interpolated between stamps, and extrapolated only with max_gap. Transforms are kept
    for HISTORY_NS. If a stamp is at least JUMP_NS older than the last one of its frame, a bag has
    restarted: moving transforms are discarded, static ones are kept. With keeps_all, for
    recordings, nothing is discarded.
    """

    def __init__(self, keeps_all: bool = False) -> None:
        self._links: dict[str, _Link] = {}  # child frame -> link to its parent
        self._keeps_all = keeps_all

    def set(
        self,
        parent: str,
        child: str,
        stamp_ns: int,
        translation: Sequence[float] | np.ndarray,
        quaternion: Sequence[float] | np.ndarray,
        static: bool = False,
    ) -> None:
        """Set the pose of a child frame in its parent at a time, or at all times if it is static.

        A new parent of the child replaces the previous one.

        Args:
            translation: (3,) metres.
            quaternion: (4,) [x y z w].

        Raises:
            InputError: The values are not a pose, a name is empty, both names are the same, or the
                tree has MAX_FRAMES frames.
        """
        parent, child = parent.lstrip("/"), child.lstrip("/")
        name = f"'{parent}' -> '{child}'"
        if not parent or not child or parent == child:
            raise InputError(
                f"the transform {name} must connect two frames with different, non-empty names; fix its publisher"
            )
        value = np.concatenate(check_pose(translation, quaternion, f"the transform {name}"))
        link = self._links.get(child)
        if link is None and len(self._links) >= MAX_FRAMES:
            raise InputError(f"more than {MAX_FRAMES} frames in TF; ignoring '{child}'")
        if link is None or (link.parent, link.static) != (parent, static):
            link = self._links[child] = _Link(parent, static, self._keeps_all)
        has_jumped_back = bool(link.times) and stamp_ns <= link.times[-1] - JUMP_NS
        if has_jumped_back and not static and not self._keeps_all:
            # Time has jumped back: only static transforms are still valid.
            self._links = {frame: known_link for frame, known_link in self._links.items() if known_link.static}
            link = self._links[child] = _Link(parent, static, self._keeps_all)
        link.add(stamp_ns, value)

    def lookup(self, target: str, source: str, stamp_ns: int, max_gap: float | None = None) -> np.ndarray:
        """Return the pose (4, 4) of source in target at a time; it transforms source to target.

        Raises:
            MissingTransform: The frames are not connected at that time.
        """
        return self.lookup_many(target, source, np.array([stamp_ns]), max_gap)[0]

    def lookup_many(self, target: str, source: str, at: np.ndarray, max_gap: float | None = None) -> np.ndarray:
        """Return the poses (M, 4, 4) of source in target.

        Args:
            target, source: Names of the frames.
            at: (M,) int times in ns, M > 0.
            max_gap: Maximum time in seconds by which moving transforms are extrapolated before
                their first and after their last pose, and maximum gap between two poses that is
                interpolated. None: no extrapolation, and any gap is interpolated.

        Raises:
            MissingTransform: The frames are not connected at one of these times.
        """
        target, source = target.lstrip("/"), source.lstrip("/")
        source_chain, target_chain = self.find_chain(source), self.find_chain(target)
        common_ancestor = next((frame for frame in source_chain if frame in set(target_chain)), None)
        if common_ancestor is None:
            raise MissingTransform(
                f"TF does not connect '{source}' with '{target}': "
                f"{self._describe(source, source_chain)}, {self._describe(target, target_chain)}"
            )
        return invert_pose(self._compose(target_chain, common_ancestor, at, max_gap)) @ self._compose(
            source_chain, common_ancestor, at, max_gap
        )

    def is_fixed(self, frame: str) -> bool:
        """Return True if a frame does not move in its parent, or has no parent."""
        link = self._links.get(frame.lstrip("/"))
        return link is None or link.static

    def find_chain(self, frame: str) -> list[str]:
        """Return the names of a frame and its ancestors, up to the root.

        Raises:
            MissingTransform: The frames form a loop.
        """
        chain = [frame.lstrip("/")]
        while (link := self._links.get(chain[-1])) is not None:
            chain.append(link.parent)
            if link.parent in chain[:-1]:
                raise MissingTransform(
                    f"TF has a loop: {' -> '.join(chain)}; two nodes publish contradicting transforms"
                )
        return chain

    def _describe(self, frame: str, chain: list[str]) -> str:
        if len(chain) > 1:
            return f"'{frame}' is below '{chain[-1]}'"
        parents = {link.parent for link in self._links.values()}
        return f"'{frame}' is " + ("the root of a tree" if frame in parents else "not in TF")

    def _compose(self, chain: list[str], end: str, at: np.ndarray, max_gap: float | None) -> np.ndarray:
        pose = np.broadcast_to(np.eye(4), (len(at), 4, 4))
        for child in chain[: chain.index(end)]:
            link = self._links[child]
            pose = link.interpolate(at, f"'{link.parent}' -> '{child}'", max_gap) @ pose
        return pose

"""What the page shows, as its server has it."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from lidar_perception.detectors.params import ScoreParams
from lidar_perception.labels.exchange import FORMATS
from lidar_perception.types import CLASSES, PEDESTRIAN
from lidar_studio.drive import Drive, classes
from lidar_studio.live import Live
from lidar_studio.session import Session


@dataclass(eq=False)
class Served:
    """What the page shows: a drive, or a running graph. session: the labels being made; None:
    results are only looked at. layers: of frame i from a score on, as /api/labels has it, None
    where there is nothing to show; tracks: as the page has them, where results are looked at."""

    drive: Drive | Live
    session: Session | None = None
    layers: Callable[[int, float], dict[str, Any]] | None = None
    tracks: Callable[[], Sequence[dict[str, Any]]] = tuple
    token: str = field(default_factory=partial(secrets.token_urlsafe, 24))

    @property
    def live(self) -> Live | None:
        """The running graph, if that is shown."""
        return self.drive if isinstance(self.drive, Live) else None

    def described(self) -> dict[str, Any]:
        """As /api/drive has it."""
        common = {"name": self.drive.name, "mode": "label" if self.session else "view",
                  "classes": classes(), "live": self.live is not None,
                  "min_score": ScoreParams().get(CLASSES[PEDESTRIAN]),
                  "can_export": [*FORMATS] if self.session else []}
        if isinstance(self.drive, Live):
            return {**common, "path": "", "layout": "live", "has": [],
                    "first": self.drive.first, "frames": self.drive.frames(),
                    "status": self.drive.status()}
        poses = (self.session or self.drive).motion.poses
        frames = [{"name": f.name, "stamp_ns": f.stamp_ns, "sequence": f.sequence,
                   "pose": None if poses is None else poses[i].ravel().tolist()}
                  for i, f in enumerate(self.drive.frames)]
        return {**common, "path": str(self.drive.recording.path), "frames": frames,
                "layout": self.drive.recording.layout, "has": sorted(self.drive.recording.has)}

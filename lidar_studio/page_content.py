"""Content of the page: a drive with labels or results, or a running graph."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from lidar_perception.detectors.params import ScoreParams
from lidar_perception.labels.exchange import FORMATS
from lidar_perception.types import CLASSES, PEDESTRIAN
from lidar_studio.drive import Drive, list_classes
from lidar_studio.live_graph import LiveGraph
from lidar_studio.session import Session


@dataclass(eq=False)
class PageContent:
    """Content of the page.

    drive: a drive, or the newest frames of a running graph.
    session: the labels being made; None if results are only viewed.
    layers: (i, min_score) -> the answer of /api/labels; None without labels and detections.
    tracks: returns the JSON objects of the tracks to view.
    token: that requests must contain.
    """

    drive: Drive | LiveGraph
    session: Session | None = None
    layers: Callable[[int, float], dict[str, Any]] | None = None
    tracks: Callable[[], Sequence[dict[str, Any]]] = tuple
    token: str = field(default_factory=partial(secrets.token_urlsafe, 24))

    @property
    def live(self) -> LiveGraph | None:
        """The running graph, None for a drive."""
        return self.drive if isinstance(self.drive, LiveGraph) else None

    def to_json(self) -> dict[str, Any]:
        """Return the answer of /api/drive."""
        common = {"name": self.drive.name, "mode": "label" if self.session else "view",
                  "classes": list_classes(), "live": self.live is not None,
                  "min_score": ScoreParams().get(CLASSES[PEDESTRIAN]),
                  "can_export": [*FORMATS] if self.session else []}
        if isinstance(self.drive, LiveGraph):
            return {**common, "path": "", "layout": "live", "has": [],
                    "first": self.drive.first, "frames": self.drive.list_frames(),
                    "status": self.drive.get_status()}
        poses = (self.session or self.drive).motion.poses
        frames = [{"name": f.name, "stamp_ns": f.stamp_ns, "sequence": f.sequence,
                   "pose": None if poses is None else poses[i].ravel().tolist()}
                  for i, f in enumerate(self.drive.frames)]
        return {**common, "path": str(self.drive.recording.path), "frames": frames,
                "layout": self.drive.recording.layout, "has": sorted(self.drive.recording.has)}

"""A run: a detector over all frames of a recording, then the formats, in order of time."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception import __version__
from lidar_perception.data.frame import Recording
from lidar_perception.detecting.formats import Format, Run, mask_numbers
from lidar_perception.detecting.results import FrameResult, by_detector, by_record
from lidar_perception.detectors.contract import Detector
from lidar_perception.detectors.open import ConfigurableDetector, resolve_weights
from lidar_perception.param_fields import flatten
from lidar_perception.runs.journal import open_journal
from lidar_perception.scoring.run import fill, fill_journal
from lidar_perception.tracking.drive_tracker import DriveTracker
from lidar_perception.tracking.params import TrackingParams
from lidar_perception.types import CLASSES

# What a run writes into its folder, besides the journal and a bag, which replaces itself.
WRITTEN = ("kitti/**/*.txt", "detections.json", "detections.csv", "openlabel/*.json",
           "png/**/*.png")


@dataclass
class Summary:
    """Counts over the results of a run, which it hands on to the formats.

    frames: number of results; boxes: number by class; tracks: ids; ms: times of the detector;
    problems: of the detector and of the tracker, each with its number of frames; skipped: a line
    for each frame without a result.
    """

    formats: Sequence[Format] = ()
    frames: int = 0
    boxes: Counter[str] = field(default_factory=Counter)
    tracks: set[int] = field(default_factory=set)
    ms: list[float] = field(default_factory=list)
    problems: Counter[str] = field(default_factory=Counter)
    skipped: list[str] = field(default_factory=list)
    _first: dict[str, str] = field(default_factory=dict)  # of problems that differ in numbers only

    def update(self, result: FrameResult) -> None:
        """Count a frame, and write it in all formats."""
        self.frames += 1
        self.boxes.update(CLASSES[i] for i in result.objects.class_ids)
        self.tracks.update([] if result.tracks is None else result.tracks.ids.tolist())
        self.ms.append(result.ms)
        for problem in filter(None, (result.problem, result.tracking_problem)):
            self.problems[self._first.setdefault(mask_numbers(problem), problem)] += 1
        for each in self.formats:
            each.add(result)

    @property
    def paths(self) -> list[Path]:
        """Where the results are; nothing is written without a result."""
        return [each.path for each in self.formats if each.path.exists()]

    def compute(self) -> dict[str, Any]:
        """All of it, as JSON can hold it; ms is the median, None without frames."""
        return {"frames": self.frames, "boxes": dict(self.boxes), "tracks": len(self.tracks),
                "ms": float(np.median(self.ms)) if self.ms else None,
                "problems": dict(self.problems), "skipped": self.skipped}


def header_of(recording: Recording, weights: str, detector: ConfigurableDetector, *,
              tracking: TrackingParams | None = None, ego: str | None = None,
              **more: Any) -> dict[str, Any]:
    """Return a JSON object with everything that the results of a run depend on: two runs with the
    same header have the same results.

    Args:
        weights: a file or a name.
        detector: opened from weights, with the thresholds of the boxes that are written.
        ego: the source of poses for the tracks.
        more: other settings.
    """
    kind, file = resolve_weights(weights)
    digest = None if file is None else hashlib.sha256(file.read_bytes()).hexdigest()[:16]
    return {"version": __version__, "data": str(recording.path.absolute()),
            "layout": recording.layout, "frames_in_data": len(recording), **more,
            "detector": kind, "weights": weights, "weights_sha256": digest,
            "range": getattr(detector, "range", "around"), "classes": list(detector.classes),
            "min_scores": dict(detector.min_scores),
            "parameters": flatten(detector.params),
            "tracking": None if tracking is None else flatten(tracking), "ego": ego}


def detect(run: Run, open_: Callable[[], Detector], formats: Sequence[Callable[[Run], Format]], *,
           tracking: TrackingParams | None = None, ego: str = "auto", jobs: int = 1,
           dask: str | None = None, force: bool = False) -> Summary:
    """Run the detector of open_() on the first run.count frames of a recording, and write what
    reaches the min_scores of run.header, or with tracking the tracks of all that it finds.

    Every finished frame is kept in run.out at once, so a run of the same header that was stopped is
    resumed, and one with other formats does not detect again. The results do not depend on that,
    nor on jobs or dask (see scoring.run.results), apart from times. InputError if run.out holds
    something else, unless force, which starts over; if results cannot be written, or a process or
    a cluster fails.
    """
    recording = run.recording
    tracker = None if tracking is None else partial(DriveTracker, params=tracking, ego=ego)
    with open_journal(run.out, run.header, force=force, list_files=written) as done:
        names = [frame.name for frame in islice(recording, run.count)]
        fill_journal(done, recording, by_detector(open_), names, jobs=jobs, dask=dask,
                     title="detecting")
        done.sort(names)

        def record_of(name: str) -> Any:
            return json.loads(done.lines[name])

        with ExitStack() as stack:
            made = [stack.enter_context(make(run)) for make in formats]
            start = by_record(record_of, run.header["min_scores"], tracker, run.say,
                              scans=any(each.needs_scans for each in made))
            summary = Summary(made, skipped=run.skipped)
            fill(summary, recording, start, limit=run.count, title="writing")
    return summary


def written(folder: Path) -> list[Path]:
    """List the files that runs have written into a folder, besides the journal."""
    return [path for pattern in WRITTEN for path in folder.glob(pattern)]

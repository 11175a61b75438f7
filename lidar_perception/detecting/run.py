"""A run: the detector on all frames of a recording, then the output formats in order of time."""

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
from lidar_perception.detecting.results import FrameResult, make_results, measure_records
from lidar_perception.detectors.contract import Detector
from lidar_perception.detectors.open import ConfigurableDetector, resolve_weights
from lidar_perception.param_fields import flatten
from lidar_perception.runs.journal import open_journal
from lidar_perception.scoring.run import fill_journal, fill_report
from lidar_perception.tracking.drive_tracker import DriveTracker
from lidar_perception.tracking.params import TrackingParams
from lidar_perception.types import CLASSES

# Output files of a run, without the journal and the bag, which is replaced as a whole.
OUTPUT_PATTERNS = ("kitti/**/*.txt", "detections.json", "detections.csv", "openlabel/*.json", "png/**/*.png")


@dataclass
class Summary:
    """Statistics of the results of a run. It also passes the results on to the formats.

    Attributes:
        frames: number of results.
        boxes: number of boxes by class.
        tracks: ids of tracks.
        ms: durations of detection.
        problems: problems of detector and tracker with their numbers of frames.
        skipped: one line for each frame without a result.
    """

    formats: Sequence[Format] = ()
    frames: int = 0
    boxes: Counter[str] = field(default_factory=Counter)
    tracks: set[int] = field(default_factory=set)
    ms: list[float] = field(default_factory=list)
    problems: Counter[str] = field(default_factory=Counter)
    skipped: list[str] = field(default_factory=list)
    _first: dict[str, str] = field(default_factory=dict)  # problem by its text without numbers

    def update(self, result: FrameResult) -> None:
        """Count a frame and write it in all formats."""
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
        """Paths of the results that exist."""
        return [each.path for each in self.formats if each.path.exists()]

    def compute(self) -> dict[str, Any]:
        """Return the statistics as JSON; ms is the median, None without frames."""
        return {
            "frames": self.frames,
            "boxes": dict(self.boxes),
            "tracks": len(self.tracks),
            "ms": float(np.median(self.ms)) if self.ms else None,
            "problems": dict(self.problems),
            "skipped": self.skipped,
        }


def make_header(
    recording: Recording,
    weights: str,
    detector: ConfigurableDetector,
    *,
    tracking: TrackingParams | None = None,
    ego: str | None = None,
    **more: Any,
) -> dict[str, Any]:
    """Return a JSON object with everything that determines the results of a run.

    Two runs with the same header have the same results.

    Args:
        weights: a file or a name.
        detector: opened from `weights`, with the thresholds of the written boxes.
        ego: source of poses for the tracks.
        more: other settings.
    """
    kind, file = resolve_weights(weights)
    digest = None if file is None else hashlib.sha256(file.read_bytes()).hexdigest()[:16]
    return {
        "version": __version__,
        "data": str(recording.path.absolute()),
        "layout": recording.layout,
        "frames_in_data": len(recording),
        **more,
        "detector": kind,
        "weights": weights,
        "weights_sha256": digest,
        "range": getattr(detector, "range", "around"),
        "classes": list(detector.classes),
        "min_scores": dict(detector.min_scores),
        "parameters": flatten(detector.params),
        "tracking": None if tracking is None else flatten(tracking),
        "ego": ego,
    }


def detect(
    run: Run,
    open_: Callable[[], Detector],
    formats: Sequence[Callable[[Run], Format]],
    *,
    tracking: TrackingParams | None = None,
    ego: str = "auto",
    jobs: int = 1,
    dask: str | None = None,
    force: bool = False,
) -> Summary:
    """Run a detector on the first run.count frames of a recording and write the results.

    Detections are written if they reach the min_scores of run.header. With tracking, the tracks of
    all detections are written instead. Finished frames are saved in run.out at once. A stopped run
    with the same header is resumed, and other formats are added without detecting again. Except for
    durations, results do not depend on resuming, jobs or dask, see scoring.run.measure_frames.

    Args:
        open_: opens the detector.
        force: start over if run.out has other results.

    Raises:
        InputError: run.out has other results, results cannot be written, or a process or the
            cluster fails.
    """
    recording = run.recording
    tracker = None if tracking is None else partial(DriveTracker, params=tracking, ego=ego)
    with open_journal(run.out, run.header, force=force, list_files=list_outputs) as done:
        names = [frame.name for frame in islice(recording, run.count)]
        fill_journal(done, recording, partial(measure_records, open_), names, jobs=jobs, dask=dask, title="detecting")
        done.sort(names)

        def read_record(name: str) -> Any:
            return json.loads(done.lines[name])

        with ExitStack() as stack:
            made = [stack.enter_context(make(run)) for make in formats]
            start = partial(
                make_results,
                read_record,
                run.header["min_scores"],
                tracker,
                run.add_remark,
                any(each.needs_scans for each in made),
            )
            summary = Summary(made, skipped=run.skipped)
            fill_report(summary, recording, start, limit=run.count, title="writing")
    return summary


def list_outputs(folder: Path) -> list[Path]:
    """List the output files of runs in a folder, without the journal."""
    return [path for pattern in OUTPUT_PATTERNS for path in folder.glob(pattern)]

"""Run a detector on all frames of a recording and write the results in chronological order."""

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
from lidar_perception.detecting.results import FrameResult, start_detection, start_results
from lidar_perception.detectors.contract import Detector
from lidar_perception.detectors.open import ConfigurableDetector, resolve_weights
from lidar_perception.param_fields import flatten
from lidar_perception.runs.journal import open_journal
from lidar_perception.scoring.run import fill_journal, fill_report
from lidar_perception.tracking.drive_tracker import DriveTracker
from lidar_perception.tracking.params import TrackingParams
from lidar_perception.types import CLASSES

# Output files of a run. Not listed: the journal, and the bag, which is always replaced.
OUTPUT_PATTERNS = ("kitti/**/*.txt", "detections.json", "detections.csv", "openlabel/*.json", "png/**/*.png")


@dataclass
class Summary:
    """Statistics of the results of a run, which also passes the results on to the output formats.

    Attributes:
        formats: output formats.
        frames: number of results.
        boxes: number of boxes of each class.
        tracks: ids of the tracks.
        ms: duration of each detection in milliseconds.
        problems: number of frames with each problem reported by the detector or tracker.
        skipped: one line for each frame without a result.
    """

    formats: Sequence[Format] = ()
    frames: int = 0
    boxes: Counter[str] = field(default_factory=Counter)
    tracks: set[int] = field(default_factory=set)
    ms: list[float] = field(default_factory=list)
    problems: Counter[str] = field(default_factory=Counter)
    skipped: list[str] = field(default_factory=list)
    _first_problems: dict[str, str] = field(default_factory=dict)  # text with masked numbers -> first such problem

    def update(self, result: FrameResult) -> None:
        """Count a frame and write it in all formats."""
        self.frames += 1
        self.boxes.update(CLASSES[i] for i in result.objects.class_ids)
        self.tracks.update([] if result.tracks is None else result.tracks.ids.tolist())
        self.ms.append(result.ms)
        for problem in filter(None, (result.problem, result.tracking_problem)):
            self.problems[self._first_problems.setdefault(mask_numbers(problem), problem)] += 1
        for output in self.formats:
            output.add(result)

    @property
    def paths(self) -> list[Path]:
        """Paths of the results that exist."""
        return [output.path for output in self.formats if output.path.exists()]

    def compute(self) -> dict[str, Any]:
        """Return the statistics as a JSON object, where ms is the median, or None without frames."""
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
    **settings: Any,
) -> dict[str, Any]:
    """Return a JSON object with everything that affects the results of a run.

    Runs with the same header have the same results.

    Args:
        weights: file or name of the weights.
        detector: detector opened from `weights`, with the thresholds for the written boxes.
        tracking: parameters of the tracker; None without tracking.
        ego: source of the sensor poses for tracking.
        settings: other settings that affect the results.
    """
    kind, weights_file = resolve_weights(weights)
    digest = None if weights_file is None else hashlib.sha256(weights_file.read_bytes()).hexdigest()[:16]
    return {
        "version": __version__,
        "data": str(recording.path.absolute()),
        "layout": recording.layout,
        "frames_in_data": len(recording),
        **settings,
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
    open_detector: Callable[[], Detector],
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
    all detections are written instead. Each finished frame is saved in run.out immediately, so that
    an interrupted run with the same header is resumed, and more formats can be written later
    without running the detector again. Except for durations, results do not depend on resuming,
    jobs or dask, see scoring.run.measure_frames.

    Args:
        open_detector: opens the detector.
        formats: constructors of the output formats.
        tracking: parameters of the tracker; None: no tracks.
        ego: source of the sensor poses for tracking.
        jobs: number of parallel processes.
        dask: address of a Dask scheduler; None: run on this machine.
        force: True to start over if run.out contains the results of a different run.

    Raises:
        InputError: run.out contains the results of a different run, results cannot be written, or a
            process or the cluster fails.
    """
    recording = run.recording
    tracker = None if tracking is None else partial(DriveTracker, params=tracking, ego=ego)
    with open_journal(run.out, run.header, force=force, list_files=list_outputs) as journal:
        names = [frame.name for frame in islice(recording, run.count)]
        fill_journal(
            journal, recording, partial(start_detection, open_detector), names, jobs=jobs, dask=dask, title="detecting"
        )
        journal.sort(names)

        def read_record(name: str) -> Any:
            return json.loads(journal.lines[name])

        with ExitStack() as stack:
            open_formats = [stack.enter_context(make(run)) for make in formats]
            start = partial(
                start_results,
                read_record,
                run.header["min_scores"],
                tracker,
                run.add_remark,
                any(output.needs_scans for output in open_formats),
            )
            summary = Summary(open_formats, skipped=run.skipped)
            fill_report(summary, recording, start, limit=run.count, title="writing")
    return summary


def list_outputs(folder: Path) -> list[Path]:
    """List the output files of runs in a folder, except the journal and the bag."""
    return [path for pattern in OUTPUT_PATTERNS for path in folder.glob(pattern)]

"""An experiment over all frames of a recording, in many processes here or on many machines."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from lidar_perception import __version__
from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.data.frame import Frame, Recording
from lidar_perception.reproduction.experiment import Experiment
from lidar_perception.reproduction.report_files import written
from lidar_perception.runs.journal import open_journal
from lidar_perception.runs.resuming import hash_names
from lidar_perception.scoring.run import fill_journal


def run(experiment: Experiment, recording: Recording, out: Path, *, jobs: int = 1,
        dask: str | None = None, force: bool = False,
        limit: int | None = None) -> list[dict[str, Any]]:
    """The records of the first `limit` frames, or of all, in their order. A frame that cannot be
    measured has {"frame": name, "skipped": why}; those whose labels have no scan come last.

    Every finished frame is kept in out/frames.jsonl at once; what a run that was stopped has kept
    is not measured again. jobs and dask: see scoring.run.results. The records do not depend on
    either, apart from times in them.

    InputError if out holds something else (see journal()) or if a process or a cluster fails.
    """
    names = [frame.name for frame in recording]
    plan = {"experiment": experiment.name, "version": __version__,
            "data": str(recording.path.resolve()), "frames": len(names),
            "frame_names": hash_names(names),
            "settings": experiment.settings}
    with open_journal(out, plan, force=force, list_files=written) as done, threadpool_limits(1):
        fill_journal(done, recording, functools.partial(_measurer, experiment), names[:limit],
                     jobs=jobs, dask=dask, title=experiment.name)
        done.sort(names)
        records = [json.loads(done.lines[name]) for name in names[:limit]]
    lost = recording.missing_scans if limit is None else ()
    return records + [{"frame": name, "skipped": reason} for name, reason in lost]


def _measurer(experiment: Experiment, recording: Recording) -> Callable[[Frame], str]:
    """What takes a frame to its record as JSON."""
    warm_up()
    number = {frame.name: i for i, frame in enumerate(recording)}

    def measure(frame: Frame) -> str:
        record = experiment.measure(recording.frames, number[frame.name])
        return json.dumps({"frame": frame.name, **record}, allow_nan=False)
    return measure

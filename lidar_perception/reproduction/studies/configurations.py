"""The two named configurations, with each source of the seed that needs nobody."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from lidar_perception.candidates.configurations import BEST, PAPER
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.segmented_cloud import SegmentedCloud
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.reproduction.experiment import Experiment, Section
from lidar_perception.reproduction.labelled import Labelled
from lidar_perception.reproduction.variants import Found, by_settings, measured_variants, sections

SOURCES = {"ground_truth": "nearest truth", "automatic": "automatic seed", "file": "template"}
VARIANTS = {f"{name}, {title}": with_values(params, {"seed.source": source})
            for source, title in SOURCES.items()
            for name, params in (("paper", PAPER), ("best", BEST))}
WITHOUT = {f"{name}, nearest truth, it left out": f"{name}, nearest truth"
           for name in ("paper", "best")}


def find(labelled: Labelled, segments: Callable[[PipelineParams], SegmentedCloud]
         ) -> dict[str, Found]:
    """Candidates by variant; once more without the seed pedestrian, which is given and so no
    merit to find."""
    found = by_settings(VARIANTS, labelled, segments)
    people = labelled.pedestrians
    given = people[np.argmin(np.hypot(people[:, 0], people[:, 1]))]
    return found | {name: found[whole]._replace(given=given) for name, whole in WITHOUT.items()}


def report(records: list[dict[str, Any]]) -> list[Section]:
    """All configurations; then the paper's protocol once more, without the seed."""
    return [*sections("The configurations", tuple(VARIANTS), records),
            *sections("The seed left out", tuple(WITHOUT), records, "without_seed")]


STUDY = Experiment(
    "configurations", "The configurations paper and best",
    "What does `best` gain, with the seed of the paper's protocol and without ground truth?",
    functools.partial(measured_variants, find), report,
    {name: flatten(params) for name, params in VARIANTS.items()})

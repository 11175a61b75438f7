"""All that is made of scenes before the training, by many processes, each file of it once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from lidar_perception.runs.processes import in_processes
from lidar_perception.runs.terminal import track
from lidar_perception.training.cache import NotKept
from lidar_perception.types import InputError


def missing(source: Any, numbers: Sequence[int]) -> list[int]:
    """Those of the numbers of which a source, with path(i), keeps nothing yet."""
    return [i for i in numbers if (path := source.path(i)) is not None and not path.is_file()]


def keep_all(sources: Sequence[Any], numbers: Sequence[Sequence[int]], jobs: int,
             title: str) -> None:
    """source.keep(i) of the numbers of each source that are missing. A scene that cannot be read is
    passed over, as it is said when it is to be learned from. InputError where one cannot be
    kept."""
    items = [(k, i) for k, (source, some) in enumerate(zip(sources, numbers))
             for i in missing(source, some)]
    if not items:
        return
    for _ in track(in_processes(partial(_keeper, tuple(sources)), items, jobs, title), title,
                   len(items)):
        pass


def _keeper(sources: tuple[Any, ...]) -> Callable[[tuple[int, int]], None]:
    def keep(item: tuple[int, int]) -> None:
        try:
            sources[item[0]].keep(item[1])
        except NotKept:
            raise
        except InputError:
            return
    return keep

"""Batches of samples from an endless stream of scenes.

The n-th sample depends only on n and the seed, not on worker processes or interruptions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import Any, NamedTuple

import numpy as np

from lidar_perception.runs.processes import run_in_order
from lidar_perception.runs.terminal import errors
from lidar_perception.types import InputError

PREFETCH = 4  # batches that each worker prepares in advance


class Item(NamedTuple):
    """A sample, and the reasons why the scenes before it were skipped."""

    sample: Any
    skipped: tuple[str, ...] = ()


@dataclass(frozen=True)
class Stream:
    """Endless sequence of samples. Each epoch contains every scene of all sources once, in a new order.

    A scene that cannot be read or prepared (InputError) is skipped and replaced by the next one.
    stream[n] raises InputError if no scene can be used.

    Attributes:
        sources: Sources with load_scene(i) and a length.
        prepare: Function prepare(scene, rng) that makes a sample.
        seed: Seed of the order and of the samples.
    """

    sources: tuple[Any, ...]
    prepare: Callable[[Any, np.random.Generator], Any]
    seed: int = 0

    def __len__(self) -> int:
        """Return the number of scenes in an epoch."""
        return sum(map(len, self.sources))

    def __getitem__(self, n: int) -> Item:
        epoch, start = divmod(n, len(self))
        order = np.random.default_rng([self.seed, epoch]).permutation(len(self))
        skipped: list[str] = []
        for offset in range(len(self)):
            rng = np.random.default_rng([self.seed, n, offset])
            try:
                source, i = find_source(self.sources, int(order[(start + offset) % len(self)]))
                return Item(self.prepare(source.load_scene(i), rng), tuple(skipped))
            except InputError as error:
                skipped.append(str(error))
        raise InputError(f"no usable scene among {len(self)} ({skipped[0]})")


def find_source(sources: Sequence[Any], n: int) -> tuple[Any, int]:
    """Return the source of the n-th scene of concatenated sources, and the scene's number in it."""
    for source in sources:
        if n < len(source):
            return source, n
        n -= len(source)
    raise IndexError(n)


@dataclass(frozen=True)
class SceneReader:
    """Concatenated sources whose n-th element is an Item; its sample is None if it cannot be read.

    Attributes:
        sources: Sources with a length.
        read: Function read(source, i) that reads one scene, or raises InputError.
    """

    sources: tuple[Any, ...]
    read: Callable[[Any, int], Any]

    def __len__(self) -> int:
        return sum(map(len, self.sources))

    def __getitem__(self, n: int) -> Item:
        try:
            return Item(self.read(*find_source(self.sources, n)))
        except InputError as error:
            return Item(None, (str(error),))


@dataclass
class Batches:
    """Batches of a stream; batches(step) iterates over the batches of this step and all later ones.

    Attributes:
        stream: The samples.
        size: Samples per batch.
        jobs: Worker processes, 0 for none.
        rank, world_size: Rank and number of processes in distributed training.
        skipped: Number of skipped scenes by reason. Each reason is printed once.
    """

    stream: Stream
    size: int
    jobs: int = 0
    rank: int = 0
    world_size: int = 1
    skipped: dict[str, int] = field(default_factory=dict)

    @property
    def steps_per_epoch(self) -> int:
        """Steps per epoch, at least 1."""
        return max(1, round(len(self.stream) / (self.size * self.world_size)))

    def __call__(self, step: int) -> Iterator[list[Any]]:
        starts = count((step * self.world_size + self.rank) * self.size, self.world_size * self.size)
        groups = (list(range(start, start + self.size)) for start in starts)
        for items in load_items(self.stream, groups, self.jobs):
            for reason in (reason for item in items for reason in item.skipped):
                if reason not in self.skipped:
                    errors.print(f"skipped: {reason}")
                self.skipped[reason] = self.skipped.get(reason, 0) + 1
            yield [item.sample for item in items]


def load_items(items: Any, groups: Iterator[list[int]], jobs: int) -> Iterator[list[Any]]:
    """Load groups of items in worker processes: yield [items[n] for n in group] in order.

    Args:
        items: Sequence that can be pickled.
        groups: Groups of indices.
        jobs: Worker processes; 0 loads in this process.

    Raises:
        InputError: A worker process ended, for example for lack of memory.
    """
    if jobs == 0:
        yield from map(_make_loader(items), groups)
    else:
        yield from run_in_order(partial(_make_loader, items), groups, jobs, PREFETCH, "prepared scenes")


def _make_loader(items: Any) -> Callable[[list[int]], list[Any]]:
    return lambda group: [items[n] for n in group]

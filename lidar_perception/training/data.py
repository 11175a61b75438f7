"""Scenes to batches: an endless stream whose n-th element depends on n and the seed alone.

So neither the number of worker processes nor a stop in between changes what is learned from.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import Any, NamedTuple

import numpy as np

from lidar_perception.runs.processes import in_order
from lidar_perception.runs.terminal import errors
from lidar_perception.types import InputError

AHEAD = 4  # batches that each worker prepares in advance


class Item(NamedTuple):
    """What prepare made of a scene, and why others were skipped."""

    sample: Any
    skipped: tuple[str, ...] = ()


@dataclass(frozen=True)
class Stream:
    """stream[n], n = 0, 1, ...: every scene of all sources once an epoch, in an order of its own;
    prepare(scene, rng) makes the sample.

    A scene that cannot be read or prepared (InputError) is skipped, and the next one in the order
    taken. InputError if none can be used.
    """

    sources: tuple[Any, ...]
    prepare: Callable[[Any, np.random.Generator], Any]
    seed: int = 0

    def __len__(self) -> int:
        """Scenes of an epoch."""
        return sum(map(len, self.sources))

    def __getitem__(self, n: int) -> Item:
        epoch, first = divmod(n, len(self))
        order = np.random.default_rng([self.seed, epoch]).permutation(len(self))
        skipped: list[str] = []
        for offset in range(len(self)):
            rng = np.random.default_rng([self.seed, n, offset])
            try:
                source, i = source_of(self.sources, int(order[(first + offset) % len(self)]))
                return Item(self.prepare(source.scene(i), rng), tuple(skipped))
            except InputError as error:
                skipped.append(str(error))
        raise InputError(f"none of the {len(self)} scenes can be used ({skipped[0]})")


def source_of(sources: Sequence[Any], n: int) -> tuple[Any, int]:
    """Of the n-th scene of all sources, one behind the other: its source, and its number there."""
    for source in sources:
        if n < len(source):
            return source, n
        n -= len(source)
    raise IndexError(n)


@dataclass(frozen=True)
class ReadScenes:
    """scenes[n]: an Item of what is read of the n-th scene of all sources, None if it cannot be
    read. read(source, i) reads one, or raises InputError."""

    sources: tuple[Any, ...]
    read: Callable[[Any, int], Any]

    def __len__(self) -> int:
        return sum(map(len, self.sources))

    def __getitem__(self, n: int) -> Item:
        try:
            return Item(self.read(*source_of(self.sources, n)))
        except InputError as error:
            return Item(None, (str(error),))


@dataclass
class Batches:
    """batches(step): lists of `size` samples, of that step and all later ones. jobs: worker
    processes, 0 for none. rank, world: which of several processes this is. skipped: the reasons so
    far, each said once."""

    stream: Stream
    size: int
    jobs: int = 0
    rank: int = 0
    world: int = 1
    skipped: dict[str, int] = field(default_factory=dict)

    @property
    def epoch(self) -> int:
        """Steps of one pass over the data, at least 1."""
        return max(1, round(len(self.stream) / (self.size * self.world)))

    def numbers(self, step: int) -> Iterator[list[int]]:
        """Elements of the stream for each step from `step` on."""
        for i in count(step):
            first = (i * self.world + self.rank) * self.size
            yield list(range(first, first + self.size))

    def __call__(self, step: int) -> Iterator[list[Any]]:
        for items in loaded(self.stream, self.numbers(step), self.jobs):
            for reason in (r for item in items for r in item.skipped):
                if reason not in self.skipped:
                    errors.print(f"skipped: {reason}")
                self.skipped[reason] = self.skipped.get(reason, 0) + 1
            yield [item.sample for item in items]


def loaded(items: Any, numbers: Iterator[list[int]], jobs: int) -> Iterator[list[Any]]:
    """[items[n] for n in each], in order, made by so many processes; 0 makes them here. InputError
    where one of these ends, as when memory is short."""
    if jobs == 0:
        yield from map(_maker(items), numbers)
    else:
        yield from in_order(partial(_maker, items), numbers, jobs, AHEAD, "prepared scenes")


def _maker(items: Any) -> Callable[[list[int]], list[Any]]:
    return lambda each: [items[n] for n in each]

"""Compiled code on several threads, as many as torch uses."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

import torch

PARTS_PER_THREAD = 4  # so that a thread that is held up leaves its work to the others


def in_parts(compute: Callable[[int, int], None], count: int, most: int) -> None:
    """Call compute(begin, end) for parts that together are 0 .. count, on as many threads as torch
    uses. compute must release the GIL to gain from it.

    Args:
        most: Number of parts that the work is worth.
    """
    threads = torch.get_num_threads()
    parts = min(most, threads * PARTS_PER_THREAD, count)
    if threads == 1 or parts < 2:
        compute(0, count)
        return
    waiting = iter([*pairwise(count * i // parts for i in range(parts + 1))])

    def work() -> None:
        for begin, end in waiting:
            compute(begin, end)

    helpers = [_pool(threads - 1).submit(work) for _ in range(threads - 1)]
    work()
    for helper in helpers:
        if not helper.cancel():  # it has begun
            helper.result()


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "in_parts")

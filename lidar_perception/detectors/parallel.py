"""Parallel execution of compiled code on several threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

from lidar_perception.runs.threads import get_thread_count

PARTS_PER_THREAD = 4  # several small parts balance the load between threads


def run_in_parts(compute: Callable[[int, int], None], count: int, max_parts: int) -> None:
    """Split range(count) into parts and call compute(begin, end) for each, on get_thread_count() threads.

    Args:
        compute: function that releases the GIL.
        max_parts: maximum number of parts; use few parts for small amounts of work.
    """
    threads = get_thread_count()
    parts = min(max_parts, threads * PARTS_PER_THREAD, count)
    if threads == 1 or parts < 2:
        compute(0, count)
        return
    queue = iter([*pairwise(count * i // parts for i in range(parts + 1))])

    def work() -> None:
        for begin, end in queue:
            compute(begin, end)

    futures = [_get_pool(threads - 1).submit(work) for _ in range(threads - 1)]
    work()
    for future in futures:
        if not future.cancel():  # False if it has already started
            future.result()


@cache
def _get_pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "run_in_parts")

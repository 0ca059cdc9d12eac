"""Threads: one pool of Python threads for compiled kernels and matrix products, so that pools never multiply."""

import functools
import itertools
import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import cv2
import threadpoolctl
import torch

T = TypeVar("T")


class Workers:
    """Runs a function over parts in `threads` threads; the function must release the GIL where its work is.

    While it exists, numpy's BLAS and OpenCV run in the thread that calls them: the parts are the parallelism.
    """

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._pool = _pool(threads) if threads > 1 else None
        self._limit = threadpoolctl.threadpool_limits(limits=1, user_api="blas")
        cv2.setNumThreads(1)

    def map(self, function: Callable[[Any], T], parts: Iterable[Any]) -> list[T]:
        """The results in the order of the parts; the first exception is raised."""
        parts = list(parts)
        if self._pool is None or len(parts) < 2:
            return [function(part) for part in parts]
        return list(self._pool.map(function, parts))


def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads in which torch, too, works alone. torch sets both the calling thread's number and that of new threads."""
    others = torch.get_num_threads()
    started = threading.Barrier(threads)

    def start() -> None:
        torch.get_num_threads()  # takes the number of new threads, which would otherwise come later and win
        torch.set_num_threads(1)
        started.wait()

    pool = ThreadPoolExecutor(threads, thread_name_prefix="pnv")
    for done in [pool.submit(start) for _ in range(threads)]:
        done.result()
    torch.set_num_threads(others)
    return pool


@functools.cache
def _workers(threads: int) -> Workers:
    return Workers(threads)


def workers(threads: int) -> Workers:
    """The pool of this many threads (0 = as many as the process may use); pools are shared and never end."""
    return _workers(threads or len(os.sched_getaffinity(0)))


def spans(length: int, parts: int, align: int = 1) -> list[tuple[int, int]]:
    """0..length cut into at most `parts` spans of nearly equal length, each starting at a multiple of `align`."""
    units = -(-length // align)
    cuts = [round(units * i / parts) * align for i in range(parts + 1)]
    return [(a, min(b, length)) for a, b in itertools.pairwise(cuts) if a < min(b, length)]

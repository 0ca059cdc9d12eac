"""Threads: one pool of Python threads for matrix products and OpenCV, so that pools never multiply."""

import functools
import itertools
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

import cv2
import threadpoolctl

T = TypeVar("T")


class Workers:
    """Runs a function over parts in `threads` threads; the function must release the GIL where its work is."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="pnv") if threads > 1 else None
        self._beside = ThreadPoolExecutor(1, thread_name_prefix="pnv beside") if threads > 1 else None

    def map(self, function: Callable[[Any], T], parts: Iterable[Any]) -> list[T]:
        """The results in the order of the parts; the first exception is raised."""
        parts = list(parts)
        with alone():
            if self._pool is None or len(parts) < 2:
                return [function(part) for part in parts]
            return list(self._pool.map(function, parts))

    def beside(self, function: Callable[[], T]) -> Callable[[], T]:
        """Starts the function in a thread of its own, where there is one; what is given waits for its result."""
        return function if self._beside is None else self._beside.submit(function).result


_alone: list[Callable[[], None]] = []  # one per caller of `alone`; the first holds what puts the numbers back
_counting = threading.Lock()


@contextmanager
def alone() -> Iterator[None]:
    """Meanwhile numpy's BLAS and OpenCV run in the thread that calls them: the parts are the parallelism.

    The numbers are the process's, so of several threads that ask at once the first changes and the last restores them.
    """
    with _counting:
        _alone.append(_alone[0] if _alone else _in_one_thread())
    try:
        yield
    finally:
        with _counting:
            restore = _alone.pop()
            if not _alone:
                restore()


def _in_one_thread() -> Callable[[], None]:
    before = cv2.getNumThreads()
    limits = _blas().limit(limits=1, user_api="blas")
    cv2.setNumThreads(1)

    def restore() -> None:
        cv2.setNumThreads(before)
        limits.restore_original_limits()

    return restore


@functools.cache
def _blas() -> threadpoolctl.ThreadpoolController:
    return threadpoolctl.ThreadpoolController()


@functools.cache
def _workers(threads: int) -> Workers:
    return Workers(threads)


def workers(threads: int) -> Workers:
    """The pool of this many threads (0 = as many as the process may use); pools are shared and never end."""
    return _workers(threads or len(os.sched_getaffinity(0)))


def shared(threads: int, verified: bool) -> tuple[int, int]:
    """Of this many threads (0 = as many as the process may use) those of the network and those of local features.

    Both run at once, and each costs least processor time in few threads. Without verification the network has all.
    """
    count = threads or len(os.sched_getaffinity(0))
    of_features = count // 2 if verified else 0
    return count - of_features, max(1, of_features)


def spans(length: int, parts: int, align: int = 1) -> list[tuple[int, int]]:
    """0..length cut into at most `parts` spans of nearly equal length, each starting at a multiple of `align`."""
    units = -(-length // align)
    cuts = [round(units * i / parts) * align for i in range(parts + 1)]
    return [(a, min(b, length)) for a, b in itertools.pairwise(cuts) if a < min(b, length)]

"""A file layer that fails: the n-th operation on the disk raises, or everything from it on does, as after a crash."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BufferedReader, FileIO
from typing import Any
from unittest import mock

from pnv_core.maps import segment


class Crash(BaseException):
    """The process ends here: nothing that would tidy up runs any more."""


class Disk:
    """Counts operations; from number `fails_at` on they raise: `times` of them an OSError, or all of them a Crash."""

    def __init__(self, fails_at: int, failure: Exception | Crash, times: int = 1) -> None:
        self.fails_at, self.failure, self.left, self.operations = fails_at, failure, times, 0

    def touch(self) -> None:
        self.operations += 1
        if self.operations > self.fails_at and (isinstance(self.failure, Crash) or self.left > 0):
            self.left -= 1
            raise self.failure

    def failing(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            self.touch()
            return function(*args, **kwargs)

        return call


@contextmanager
def faults(fails_at: int, failure: Exception | Crash, times: int = 1) -> Iterator[Disk]:
    """Every file operation of maps goes over a disk that fails."""
    disk = Disk(fails_at, failure, times)

    class Output(FileIO):
        def write(self, data: Any) -> int:
            whole = memoryview(data)
            if len(whole) > 100 and disk.operations % 7 == 3:  # a disk may take less than it is given
                whole = whole[: len(whole) // 2]
            disk.touch()
            return super().write(whole)

    class Input:
        def __init__(self, file: BufferedReader) -> None:
            self._file = file

        def __getattr__(self, name: str) -> Any:
            return getattr(self._file, name)

        def __enter__(self) -> "Input":
            return self

        def __exit__(self, *_: object) -> None:
            self._file.close()

        def read(self, size: int = -1) -> bytes:
            disk.touch()
            return self._file.read(size)

        def readinto(self, buffer: Any) -> int:
            disk.touch()
            return self._file.readinto(buffer)

    genuine = segment.open_regular

    def opened(path: Any) -> Any:
        disk.touch()
        return Input(genuine(path))

    with mock.patch.object(segment, "FileIO", Output), mock.patch.object(segment, "open_regular", opened):
        names = ("fsync", "replace", "link", "unlink", "mkdir", "makedirs", "listdir", "open")
        patches = [mock.patch.object(os, name, disk.failing(getattr(os, name))) for name in names]
        for patch in patches:
            patch.start()
        try:
            yield disk
        finally:
            for patch in patches:
                patch.stop()

"""Patches of cold keyframes on disk: one unnamed file of places in steps of an eighth of their size.

Read and written by position, not memory-mapped: a page of a mapping counts as the process's memory while it is
cached and turns an I/O error into a crash, where `pread` gives an OSError.
"""

import os
import tempfile
from collections import defaultdict, deque
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnv_core.errors import ConfigError


class DiskBuffer:
    """A buffer in the file; its place is used again when nothing refers to it any more."""

    __slots__ = ("_file", "_free", "nbytes", "place")

    def __init__(self, file: "PatchFile", free: deque[int], place: int, nbytes: int) -> None:
        self._file = file
        self._free = free
        self.place = place
        self.nbytes = nbytes

    def read(self) -> NDArray[np.uint8]:
        """(nbytes,) uint8. Raises OSError."""
        return self._file.read(self.place, self.nbytes)

    def __del__(self) -> None:
        self._free.append(self.place)


class PatchFile:
    """Takes buffers until `limit` bytes; the file has no name, so nothing stays behind however the process ends."""

    def __init__(self, folder: str, limit: int) -> None:
        # /var/tmp, not /tmp: the latter is memory on many systems
        self.folder = Path(folder) if folder else Path("/var/tmp")
        try:
            self._handle = tempfile.TemporaryFile(dir=self.folder)  # noqa: SIM115 (lives as long as this object)
        except OSError as error:
            raise ConfigError(
                f"patch_folder = {str(self.folder)!r}: {error.strerror}; allowed: a writable folder"
            ) from error
        self.limit = limit
        self.end = 0
        self._free: defaultdict[int, deque[int]] = defaultdict(deque)  # by room

    def write(self, buffer: NDArray[np.uint8]) -> DiskBuffer | None:
        """The buffer on disk; None when the limit is reached. Raises OSError (a full disk)."""
        room = _room(len(buffer))
        free = self._free[room]
        place = free.popleft() if free else self.end
        if place == self.end and self.end + room > self.limit:
            return None
        try:
            self._write_at(place, buffer.data)
        except OSError:
            if place != self.end:
                free.append(place)
            raise
        self.end = max(self.end, place + room)
        return DiskBuffer(self, free, place, len(buffer))

    def _write_at(self, place: int, data: memoryview) -> None:
        while data:
            written = os.pwrite(self._handle.fileno(), data, place)
            place, data = place + written, data[written:]

    def read(self, place: int, nbytes: int) -> NDArray[np.uint8]:
        buffer = np.empty(nbytes, np.uint8)
        got = os.preadv(self._handle.fileno(), [buffer.data], place)
        if got != nbytes:
            raise OSError(f"patch file in {self.folder}: {got} of {nbytes} bytes at {place}")
        buffer.flags.writeable = False
        return buffer


def _room(nbytes: int) -> int:
    """The place for a buffer: an eighth larger at most, so that keyframes of about one size share their places."""
    step = 1 << max(0, nbytes.bit_length() - 4)
    return -(-nbytes // step) * step

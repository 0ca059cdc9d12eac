"""The global vectors of all keyframes in one matrix, one row per keyframe, with what a query filters by."""

import mmap
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pnv_core.errors import ConfigError

_MAP_NORESERVE = 0x4000  # Linux; the mmap module names it from Python 3.13 on


def reserve(rows: int, columns: tuple[int, ...], dtype: np.dtype | type) -> NDArray:
    """A zero array (rows, *columns) whose pages take memory only once they are written.

    It never moves and never grows, so that no add copies the matrix and bytes are counted by rows in use.
    """
    shape = (rows, *columns)
    nbytes = max(1, int(np.prod(shape)) * np.dtype(dtype).itemsize)
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _MAP_NORESERVE
    try:
        memory = mmap.mmap(-1, nbytes, flags=flags)
    except OSError as error:
        raise ConfigError(f"memory_budget_mb needs {nbytes >> 20} MB of address space: {error}") from error
    return np.frombuffer(memory, dtype, count=int(np.prod(shape))).reshape(shape)


class Row:
    """A row of the matrix, given back when the last keyframe or snapshot that refers to it lets go."""

    __slots__ = ("_free", "slot")

    def __init__(self, free: deque[int], slot: int) -> None:
        self._free = free
        self.slot = slot

    def __del__(self) -> None:
        self._free.append(self.slot)


class VectorTable:
    """Up to `rows` unit vectors (D,) float32 with id, stamp, session and camera number of each.

    Rows are reused once free. A removed row keeps its vector as long as its Row lives (a snapshot may be reading it).
    """

    def __init__(self, rows: int, dim: int) -> None:
        self.vectors = reserve(rows, (dim,), np.float32)  # (rows, D)
        self.ids = reserve(rows, (), np.int64)
        self.stamps = reserve(rows, (), np.int64)
        self.sessions = reserve(rows, (), np.int32)
        self.cameras = reserve(rows, (), np.int16)
        self.live = reserve(rows, (), np.bool_)
        self.high = 0  # rows ever used
        self._free: deque[int] = deque()

    @property
    def dim(self) -> int:
        return self.vectors.shape[1]

    @property
    def row_bytes(self) -> int:
        """Bytes of one row over all columns."""
        return self.dim * 4 + 8 + 8 + 4 + 2 + 1

    def nbytes(self, more: int = 0) -> int:
        """Bytes of the rows ever used, now or after `more` further rows."""
        return max(self.high, self.high + more - len(self._free)) * self.row_bytes

    def add(self, vector: NDArray[np.float32], keyframe: int, stamp_ns: int, session: int, camera: int) -> Row:
        """Raises IndexError when full."""
        if self._free:
            slot = self._free.popleft()
        elif self.high < len(self.live):
            slot, self.high = self.high, self.high + 1
        else:
            raise IndexError(f"all {len(self.live)} rows are in use")
        self.vectors[slot] = vector
        self.ids[slot], self.stamps[slot] = keyframe, stamp_ns
        self.sessions[slot], self.cameras[slot] = session, camera
        self.live[slot] = True
        return Row(self._free, slot)

    def remove(self, row: Row) -> None:
        self.live[row.slot] = False


@dataclass(frozen=True)
class Allowed:
    """Which rows a query may match: live, of another session or not after `before_ns`, of this camera if given."""

    table: VectorTable
    session: int
    before_ns: int
    camera: int | None

    def all(self) -> NDArray[np.bool_]:
        """(high,) of every row."""
        return self.of(slice(0, self.table.high))

    def of(self, rows: slice | NDArray[np.int64]) -> NDArray[np.bool_]:
        """Of these rows; a scan of a million asks for a thousand of them only."""
        table = self.table
        mask = (table.sessions[rows] != self.session) | (table.stamps[rows] <= self.before_ns)
        mask &= table.live[rows]
        if self.camera is not None:
            mask &= table.cameras[rows] == self.camera
        return mask

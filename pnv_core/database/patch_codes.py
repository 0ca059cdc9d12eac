"""Patch descriptors as they are stored: one buffer per keyframe in float32, float16 or int8.

P = patches of one size, D = descriptor dimension. An int8 row is its float row divided by a scale of its own
(max |x| / 127), so that the product of two rows is (int8 . int8) * scale * scale.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pnv_core.types import PatchGrid

Shapes = tuple[tuple[int, int, int, int, int], ...]  # (size, rows, cols, stride, D) per patch size

DTYPES: dict[str, np.dtype] = {"float32": np.dtype("<f4"), "float16": np.dtype("<f2"), "int8": np.dtype("i1")}
# The bits of 2.0 by width: no value of a unit row is larger, and as whole numbers infinity and NaN lie above.
_LARGEST = {2: np.int16(0x4000), 4: np.int32(0x40000000)}
_ALIGN = 64  # bytes: every array in a buffer starts on a cache line, as SIMD loads want it


@dataclass(frozen=True)
class GridLayout:
    """Where one patch grid lies in a buffer. Equal layouts are shared between keyframes."""

    size: int
    rows: int
    cols: int
    stride: int
    dim: int
    precision: str
    codes_at: int
    scales_at: int  # -1 without scales
    end: int

    @property
    def patches(self) -> int:
        return self.rows * self.cols


@dataclass(frozen=True, eq=False)
class PatchCodes:
    """One patch size as stored: codes (P, D) in the stored precision; scales (P,) float32 for int8, None otherwise."""

    size: int
    rows: int
    cols: int
    stride: int
    codes: NDArray
    scales: NDArray[np.float32] | None

    def decode(self) -> NDArray[np.float32]:
        """(P, D) float32."""
        if self.scales is None:
            return self.codes.astype(np.float32, copy=False)
        return self.codes.astype(np.float32) * self.scales[:, None]

    def grid(self, cell: int) -> PatchGrid:
        """As a PatchGrid of cells of `cell` px: float32 and float16 codes as they are (no copy), int8 as float32."""
        descriptors = self.codes if self.scales is None else self.decode()
        return PatchGrid(self.size, self.rows, self.cols, descriptors, self.stride, cell)


def layout_of(grids: tuple[PatchGrid, ...], precision: str) -> tuple[GridLayout, ...]:
    """The buffer layout of these grids in this precision. Raises ValueError for a grid of the wrong shape."""
    shapes = []
    for grid in grids:
        patches, dim = grid.descriptors.shape
        if patches != grid.rows * grid.cols:
            raise ValueError(
                f"patch grid {grid.rows} x {grid.cols} of size {grid.size} has {patches} descriptors; "
                f"allowed: {grid.rows * grid.cols}"
            )
        shapes.append((grid.size, grid.rows, grid.cols, grid.stride, dim))
    return layout_of_shapes(shapes, precision)


def layout_of_shapes(shapes: Iterable[tuple[int, int, int, int, int]], precision: str) -> tuple[GridLayout, ...]:
    """The buffer layout of grids given as (size, rows, cols, stride, D)."""
    layouts = []
    at = 0
    for size, rows, cols, stride, dim in shapes:
        codes_at = at
        at += _padded(rows * cols * dim * DTYPES[precision].itemsize)
        scales_at = -1
        if precision == "int8":
            scales_at = at
            at += _padded(rows * cols * 4)
        layouts.append(GridLayout(size, rows, cols, stride, dim, precision, codes_at, scales_at, end=at))
    return tuple(layouts)


def _padded(nbytes: int) -> int:
    return -(-nbytes // _ALIGN) * _ALIGN


def buffer_bytes(layouts: tuple[GridLayout, ...]) -> int:
    """Bytes of the buffer of one keyframe."""
    return layouts[-1].end if layouts else 0


def shapes_of(layouts: tuple[GridLayout, ...]) -> Shapes:
    """What `layout_of_shapes` made these of."""
    return tuple((g.size, g.rows, g.cols, g.stride, g.dim) for g in layouts)


def plausible(buffer: NDArray[np.uint8], layouts: tuple[GridLayout, ...]) -> bool:
    """Whether every stored value is finite and no larger than one of a unit row can be; int8 by its scales."""
    for view in views(buffer, layouts):
        values = view.codes if view.scales is None else view.scales
        bits = values.view(f"<i{values.itemsize}") & (0x7FFF if values.itemsize == 2 else 0x7FFFFFFF)
        if bits.size and bits.max() > _LARGEST[values.itemsize]:
            return False
    return True


def encode(grids: tuple[PatchGrid, ...], layouts: tuple[GridLayout, ...]) -> NDArray[np.uint8]:
    """The grids in one read-only buffer (buffer_bytes(layouts),) uint8."""
    buffer = np.zeros(buffer_bytes(layouts), np.uint8)
    for grid, view in zip(grids, views(buffer, layouts), strict=True):
        if view.scales is not None:
            values = np.asarray(grid.descriptors, np.float32)
            scales = np.abs(values).max(axis=1) / np.float32(127)
            view.scales[:] = scales
            view.codes[:] = np.rint(values / np.where(scales > 0, scales, 1)[:, None])
        else:
            view.codes[:] = grid.descriptors
    buffer.flags.writeable = False
    return buffer


def views(buffer: NDArray[np.uint8], layouts: tuple[GridLayout, ...]) -> tuple[PatchCodes, ...]:
    """The arrays inside a buffer, without copying."""
    return tuple(_view(buffer, layout) for layout in layouts)


def _view(buffer: NDArray[np.uint8], at: GridLayout) -> PatchCodes:
    dtype = DTYPES[at.precision]
    codes = buffer[at.codes_at : at.codes_at + at.patches * at.dim * dtype.itemsize].view(dtype)
    scales = None
    if at.scales_at >= 0:
        scales = buffer[at.scales_at : at.scales_at + at.patches * 4].view("<f4")
    return PatchCodes(at.size, at.rows, at.cols, at.stride, codes.reshape(at.patches, at.dim), scales)

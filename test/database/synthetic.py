"""Descriptors without a network: random ones, and a robot that drives past places."""

from collections.abc import Iterator

import numpy as np

from pnv_core.types import PatchGrid, PlaceDescriptor

SECOND = 10**9


def unit(values: np.ndarray) -> np.ndarray:
    """Rows of unit length, float32."""
    return (values / np.linalg.norm(values, axis=-1, keepdims=True)).astype(np.float32)


def place(rng: np.random.Generator, dim: int = 16, patches: int = 6, patch_dim: int = 8) -> PlaceDescriptor:
    """A random place with patches of two sizes."""
    grids = tuple(
        PatchGrid(size, 2, patches // 2, unit(rng.standard_normal((patches // 2 * 2, patch_dim)))) for size in (2, 5)
    )
    return PlaceDescriptor(unit(rng.standard_normal(dim)), grids if patches else (), texture=float(rng.uniform()))


def drive(rng: np.random.Generator, count: int, step: float, dim: int = 16) -> Iterator[PlaceDescriptor]:
    """Global vectors of a robot that moves on by about `step` radians a frame; step 0 stands still."""
    vector = unit(rng.standard_normal(dim))
    for _ in range(count):
        yield PlaceDescriptor(vector, ())
        vector = unit(vector + step * rng.standard_normal(dim) / np.sqrt(dim))

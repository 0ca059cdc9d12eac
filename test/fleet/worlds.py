"""Small places and a store's server in a process of its own."""

from uuid import uuid4

import numpy as np

from pnv_core.types import PatchGrid, PlaceDescriptor
from pnv_fleet.places import Place, encode_view

DIM = 32


def new_model() -> str:
    """The fingerprint of a model nobody has used."""
    return 2 * uuid4().hex


def unit(rng: np.random.Generator, *shape: int) -> np.ndarray:
    rows = rng.standard_normal(shape).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def descriptor(seed: int, thumbnail: bytes = b"") -> PlaceDescriptor:
    rng = np.random.default_rng(seed)
    return PlaceDescriptor(unit(rng, DIM), (PatchGrid(2, 3, 4, unit(rng, 12, 16)),), 0.5, thumbnail)


def place(number: int, robot: str = "alpha", position: tuple[float, float, float] | None = None) -> Place:
    seen = descriptor(number)
    return Place(
        robot, 10**18, "front", number, 10**18 + number * 10**9, 0.5, seen.global_vector, encode_view(seen), position
    )

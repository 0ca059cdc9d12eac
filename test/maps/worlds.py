"""Small maps and what is compared of them."""

from pathlib import Path

import numpy as np

from pnv_core.database import KeyframeDatabase
from pnv_core.maps import MapStore
from pnv_core.maps.reading import open_map
from test.database.synthetic import SECOND, place

MODEL = "f" * 16


def driven(count: int, seed: int = 0, **options) -> KeyframeDatabase:
    """A database of `count` random places seen by two cameras."""
    database = KeyframeDatabase(16, **{"memory_budget_mb": 1.0, "patch_precision": "int8"} | options)
    go_on(database, count, seed)
    return database


def go_on(database: KeyframeDatabase, count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(count):
        last = database.last()
        number = 0 if last is None else last.id + 1
        database.add(number * SECOND + 7, ("front", "rear")[number % 2], place(rng))


def saved(path: Path, *saves: int, **options) -> KeyframeDatabase:
    """A map on disk, made by several saves with so many keyframes more each time."""
    database = driven(0, **options)
    store = MapStore(path, MODEL)
    for seed, count in enumerate(saves):
        go_on(database, count, seed)
        store.save(database.snapshot())
        database.new_session()
    return database


def contents(database: KeyframeDatabase) -> list[tuple]:
    """Everything that is remembered, comparable."""
    return [_facts(kf) for kf in database.snapshot().keyframes]


def on_disk(path: Path) -> list[tuple]:
    with open_map(path) as opened:
        return [_facts(kf) for kf in opened.keyframes()]


def _facts(kf) -> tuple:
    return kf.ref, kf.layouts, kf.texture, kf.vector.tobytes(), kf.read().tobytes()

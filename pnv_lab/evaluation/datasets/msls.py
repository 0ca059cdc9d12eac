"""Mapillary Street-level Sequences.

Where: https://www.mapillary.com/dataset/places.
Layout: ROOT/train_val/CITY/query and database, each with images/KEY.jpg, postprocessed.csv, raw.csv and
subtask_index.csv. The test cities have no positions: they are measured by the benchmark's server.
Rule: at most 25 m away and 40 degrees turned (Patch-NetVLAD section 4.3). Panoramas are left out, as in the authors'
loader; the validation cities are cph and sf.
"""

from pathlib import Path

import numpy as np

from pnv_core.errors import PnvError
from pnv_lab.evaluation.datasets.dataset import Dataset
from pnv_lab.evaluation.datasets.pose_truth import within_radius
from pnv_lab.evaluation.datasets.tables import existing, number, rows

RADIUS_M = 25.0
ANGLE_DEG = 40.0
_VALIDATION = ("cph", "sf")
_YES = ("true", "1", "1.0")


def msls(root: Path, split: str = "") -> Dataset:
    """`split` is val (cph and sf), or city names joined by commas."""
    cities = _VALIDATION if split in ("", "val") else tuple(split.split(","))
    queries: list[Path] = []
    references: list[Path] = []
    truth = []
    conditions: list[str] = []
    for city in cities:
        folder = root / "train_val" / city
        if not folder.is_dir():
            raise PnvError(f"{folder}: no such city; allowed: --split with the cities under {root / 'train_val'}")
        asked, asked_at, asked_turn, night = _images(folder / "query")
        known, known_at, known_turn, _ = _images(folder / "database")
        for near, turn in zip(within_radius(asked_at, known_at, RADIUS_M), asked_turn, strict=True):
            difference = np.abs((known_turn[near] - turn + 180.0) % 360.0 - 180.0)
            truth.append(near[difference <= ANGLE_DEG] + len(references))
        queries += asked
        references += known
        conditions += [f"{city} {'night' if dark else 'day'}" for dark in night]
    rule = f"at most {RADIUS_M:g} m away and {ANGLE_DEG:g} degrees turned"
    return Dataset("msls", tuple(queries), tuple(references), tuple(truth), rule, conditions=tuple(conditions))


def _images(folder: Path) -> tuple[list[Path], np.ndarray, np.ndarray, list[bool]]:
    """Files, (N, 2) positions, (N,) compass angles in degrees, and whether it is night."""
    placed = rows(folder / "postprocessed.csv", ("key", "easting", "northing", "night"))
    raw = {r["key"]: r for r in rows(folder / "raw.csv", ("key", "ca", "pano"))}
    chosen = {r["key"] for r in rows(folder / "subtask_index.csv", ("key", "all")) if r["all"].lower() in _YES}
    kept = [r for r in placed if r["key"] in chosen and r["key"] in raw and raw[r["key"]]["pano"].lower() not in _YES]
    if not kept:
        raise PnvError(f"{folder}: no image is left after the panoramas; is raw.csv of the same release?")
    files = existing(folder / "images", [f"{r['key']}.jpg" for r in kept])
    post, rawfile = folder / "postprocessed.csv", folder / "raw.csv"
    at = np.array([[number(post, r, "easting"), number(post, r, "northing")] for r in kept])
    turn = np.array([number(rawfile, raw[r["key"]], "ca") for r in kept])
    return list(files), at, turn, [r["night"].lower() in _YES for r in kept]

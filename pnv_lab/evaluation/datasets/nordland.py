"""Nordland: one railway line filmed in four seasons, aligned frame by frame.

Where: https://nrkbeta.no/2013/01/15/nordlandsbanen-minute-by-minute-season-by-season/ (the films); frames at 1 fps.
Layout: ROOT/summer/*.png and ROOT/winter/*.png (any two seasons) with the same number of frames; optionally
ROOT/cleanImageNames.txt, one frame name per line, to leave out tunnels and stops.
Rule: a reference at most 10 frames away (Patch-NetVLAD section 4.3). The paper asks winter against summer.
"""

from pathlib import Path

import numpy as np

from pnv_core.errors import PnvError
from pnv_core.images import list_images
from pnv_lab.evaluation.datasets.dataset import Dataset
from pnv_lab.evaluation.datasets.tables import words

TOLERANCE_FRAMES = 10


def nordland(root: Path, split: str = "") -> Dataset:
    """`split` is QUERIES/REFERENCES, two seasons; by default winter/summer."""
    seasons = (split or "winter/summer").split("/")
    if len(seasons) != 2:
        raise PnvError(f"--split {split!r}; allowed for nordland: QUERIES/REFERENCES, such as winter/summer")
    queries, references = (list_images(root / season) for season in seasons)
    if len(queries) != len(references):
        raise PnvError(
            f"{root}: {len(queries)} {seasons[0]} and {len(references)} {seasons[1]} frames; allowed: as many"
        )
    clean = root / "cleanImageNames.txt"
    if clean.is_file():
        kept = {Path(line[0]).name for _, line in words(clean)}
        rows = [i for i, (q, r) in enumerate(zip(queries, references, strict=True)) if q.name in kept or r.name in kept]
        queries, references = [queries[i] for i in rows], [references[i] for i in rows]
    count = len(queries)
    truth = [np.arange(max(0, i - TOLERANCE_FRAMES), min(count, i + TOLERANCE_FRAMES + 1)) for i in range(count)]
    return Dataset(
        "nordland", tuple(queries), tuple(references), tuple(truth), f"at most {TOLERANCE_FRAMES} frames away"
    )

"""The simplest layout: a folder with matches.csv or poses.csv.

matches.csv has the columns query,true_refs (paths relative to the file, references separated by ;). Where queries and
references lie in one folder (or in ROOT/images) the images are a sequence in name order, stamped by
ROOT/frames.csv (frame,timestamp in seconds) if there is one: a query then finds only images that are old enough.
"""

from pathlib import Path

import numpy as np

from pnv_core.errors import PnvError
from pnv_lab.evaluation.datasets.dataset import NONE, Dataset
from pnv_lab.evaluation.datasets.pairs import images_under, pairs_dataset, read_matches
from pnv_lab.evaluation.datasets.sequences import SequenceRule, older_than, poses_csv
from pnv_lab.evaluation.datasets.tables import number, rows


def folder(root: Path, rule: SequenceRule) -> Dataset:
    """A folder with matches.csv, or with poses.csv."""
    if not root.is_dir():
        raise PnvError(f"{root}: no such folder")
    matches = root / "matches.csv"
    if not matches.is_file():
        if (root / "poses.csv").is_file():
            return poses_csv(root, rule)
        raise PnvError(f"{root}: holds neither matches.csv nor poses.csv")
    images = root / "images"
    listed = read_matches(matches, images, images)
    queries = {query.parent.resolve() for _, query, _ in listed}
    references = {t.parent.resolve() for _, _, true in listed for t in true}
    if queries & references:
        return _sequence(root, images if images.is_dir() else root, rule)
    return pairs_dataset(_common(queries), _common(references), matches, root.name)


def _common(parents: set[Path]) -> Path:
    """The folder that holds all of them."""
    first = min(parents)
    for candidate in (first, *first.parents):
        if all(candidate in (p, *p.parents) for p in parents):
            return candidate
    return first


def _sequence(root: Path, images: Path, rule: SequenceRule) -> Dataset:
    files = images_under(images)
    position = {p.resolve(): i for i, p in enumerate(files)}
    source = root / "frames.csv"
    own = tuple(np.array([i], np.int64) for i in range(len(files)))
    excluded, stamps, ruled = own, None, "as matches.csv says"
    if source.is_file():
        seconds = {r["frame"]: number(source, r, "timestamp") for r in rows(source, ("frame", "timestamp"))}
        if missing := [p.name for p in files if p.name not in seconds]:
            raise PnvError(f"{source}: no timestamp for {missing[0]}")
        stamps = np.array([seconds[p.name] for p in files])
        order = np.argsort(stamps, kind="stable")
        files, stamps = [files[i] for i in order], stamps[order]
        position = {p.resolve(): i for i, p in enumerate(files)}
        excluded = older_than(stamps, rule.exclude_recent_s)
        ruled += f", at least {rule.exclude_recent_s:g} s older"
    truth = [NONE] * len(files)
    for line, query, true in read_matches(root / "matches.csv", images, images):
        if query.resolve() not in position:
            raise PnvError(f"{root / 'matches.csv'} line {line}: {query} is not under {images}")
        q = position[query.resolve()]
        wanted = np.array(sorted(position[t.resolve()] for t in true if t.resolve() in position), np.int64)
        truth[q] = np.setdiff1d(wanted, excluded[q])
    return Dataset(
        root.name, tuple(files), tuple(files), tuple(truth), ruled, excluded=excluded, sequence=True, stamps=stamps
    )

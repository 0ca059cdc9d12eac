"""Two folders of images and a matches.csv."""

import csv
from pathlib import Path

import numpy as np

from pnv_core.errors import ImageError, PnvError
from pnv_core.images import SUFFIXES
from pnv_lab.evaluation.datasets.dataset import NONE, Dataset

COLUMNS = ("query", "true_refs")


def images_under(folder: Path | str) -> list[Path]:
    """Every image of a folder and its sub-folders, in name order. Raises ImageError if there is none."""
    place = Path(folder)
    if not place.is_dir():
        raise ImageError(f"{folder}: no such folder of images")
    found = sorted(p for p in place.rglob("*") if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
    if not found:
        raise ImageError(f"{folder}: holds no image; allowed: {', '.join(SUFFIXES)}")
    return found


def read_matches(path: Path | str, queries: Path, references: Path) -> list[tuple[int, Path, list[Path]]]:
    """(line, query, true references) of every row, as existing files.

    Paths are relative to the csv file; a bare name may also be relative to the folder of queries or references.
    Raises PnvError naming file, line and what is missing.
    """
    source = Path(path)
    try:
        with open(source, newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            if not set(COLUMNS) <= set(reader.fieldnames or ()):
                given = ", ".join(reader.fieldnames or ()) or "none"
                raise PnvError(f"{source}: has the columns {given}; allowed: {', '.join(COLUMNS)}")
            rows = [(reader.line_num, row) for row in reader]
    except (UnicodeDecodeError, csv.Error) as error:
        raise PnvError(f"{source}: is no csv text ({error})") from None

    def existing(text: str, folder: Path, line: int) -> Path:
        for base in (source.parent, folder):
            if (base / text).is_file():
                return base / text
        raise PnvError(f"{source} line {line}: {text}: no such image beside the csv file or in {folder}")

    found = []
    for line, row in rows:
        name = (row["query"] or "").strip()
        if not name:
            raise PnvError(f"{source} line {line}: the query is empty; allowed: a path relative to the file")
        true = [t.strip() for t in (row["true_refs"] or "").split(";") if t.strip()]
        found.append((line, existing(name, queries, line), [existing(t, references, line) for t in true]))
    return found


def pairs_dataset(queries: Path | str, references: Path | str, matches: Path | str, name: str = "") -> Dataset:
    """Queries and references from two folders, the ground truth from a csv of query,true_refs.

    Only queries of the folder that the csv lists are asked. Where both folders share images, none finds itself.
    """
    query_files = {p.resolve(): p for p in images_under(queries)}
    reference_files = images_under(references)
    number = {p.resolve(): i for i, p in enumerate(reference_files)}
    chosen: dict[Path, set[int]] = {}
    outside = 0
    for _, query, true in read_matches(matches, Path(queries), Path(references)):
        if query.resolve() not in query_files:
            outside += 1
            continue
        chosen.setdefault(query.resolve(), set()).update(number[t.resolve()] for t in true if t.resolve() in number)
    if not chosen:
        raise PnvError(f"{matches}: lists no image of {queries}")
    names = sorted(chosen)
    own = tuple(np.array([number[q]], np.int64) if q in number else NONE for q in names)
    return Dataset(
        name or Path(matches).resolve().parent.name,
        tuple(query_files[q] for q in names),
        tuple(reference_files),
        tuple(np.array(sorted(chosen[q] - set(own[i].tolist())), np.int64) for i, q in enumerate(names)),
        rule=f"as {Path(matches).name} says",
        excluded=own if any(len(o) for o in own) else None,
        notes=(f"{outside} rows name images outside {queries}",) if outside else (),
    )

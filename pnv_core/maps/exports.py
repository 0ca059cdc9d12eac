"""What a map, with poses and closures from beside it, gives other programs."""

import csv
from collections.abc import Iterable
from pathlib import Path

from pnv_core.errors import PnvError
from pnv_core.maps.reading import open_map
from pnv_core.types import ImageRef, LoopClosure


def refs_of(path: Path) -> list[ImageRef]:
    """Every keyframe of a map, by ascending id. Raises MapError."""
    with open_map(path) as opened:
        return [kf.ref for kf in opened.keyframes()]


def closures_of(path: Path, refs: Iterable[ImageRef]) -> tuple[list[LoopClosure], dict[int, str]]:
    """The accepted closures of a table of `pnv run --csv` between these keyframes, and what it calls them by id.

    A keyframe is found by its stamp; where two cameras share one, the first counts. Raises PnvError for a table that
    is none.
    """
    by_stamp: dict[int, ImageRef] = {}
    for ref in refs:
        by_stamp.setdefault(ref.stamp_ns, ref)
    closures: list[LoopClosure] = []
    names: dict[int, str] = {}
    try:
        with open(path, newline="", encoding="utf-8") as file:
            for line, row in enumerate(csv.DictReader(file), 2):
                try:
                    ends = [by_stamp.get(_stamp_ns(row[f"{side}_stamp"])) for side in ("query", "match")]
                    score, accepted = float(row["score"]), int(row["accepted"])
                except (KeyError, ValueError, TypeError) as error:
                    raise PnvError(
                        f"{path}: line {line}: {error!r}; allowed: a table of closures as pnv run --csv writes it"
                    ) from None
                query, match = ends
                if accepted and query is not None and match is not None:
                    closures.append(LoopClosure(query, match, score, 0.0, 0.0, 0, True))
                    names |= {ref.id: row[side] for ref, side in ((query, "query"), (match, "match")) if row.get(side)}
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise PnvError(f"{path}: cannot be read ({error}); allowed: a table of closures") from None
    return closures, names


def _stamp_ns(text: str) -> int:
    """Decimal seconds with nine digits, exactly. Raises ValueError."""
    seconds, _, fraction = text.partition(".")
    return int(seconds) * 10**9 + int(fraction.ljust(9, "0")[:9] or 0)

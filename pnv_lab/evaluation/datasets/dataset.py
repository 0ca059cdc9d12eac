"""What an evaluation needs of a data set. Q queries, R references."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnv_core.errors import PnvError

Indices = NDArray[np.int64]
NONE: Indices = np.empty(0, np.int64)


@dataclass(frozen=True, eq=False)
class Dataset:
    """Images and ground truth. `truth[q]` are the references that show the place of query q.

    excluded: per query the references that may not be found (the image itself, or frames just seen).
    groups: (R,) references of equal number count as one answer (the cut-outs of a panorama).
    conditions: per query a word to split the results by. `*_poses`: (N, 4, 4) camera to world, where tolerances ask
    for poses. `names`: how the benchmark calls each query. Of a sequence (queries = references, in time order)
    `query_positions` (Q, 3) in metres and `stamps` (Q,) in seconds are kept for the report.
    """

    name: str
    queries: tuple[Path, ...]
    references: tuple[Path, ...]
    truth: tuple[Indices, ...]
    rule: str = ""
    excluded: tuple[Indices, ...] | None = None
    groups: Indices | None = None
    conditions: tuple[str, ...] = ()
    query_poses: NDArray[np.float64] | None = None
    reference_poses: NDArray[np.float64] | None = None
    names: tuple[str, ...] = ()
    sequence: bool = False
    query_positions: NDArray[np.float64] | None = None
    stamps: NDArray[np.float64] | None = None
    notes: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        if not self.queries or not self.references:
            what = "query" if not self.queries else "reference"
            raise PnvError(f"{self.name}: no {what} image; allowed: at least one query and one reference")
        if len(self.truth) != len(self.queries):
            raise PnvError(f"{self.name}: ground truth for {len(self.truth)} of {len(self.queries)} queries")

    @property
    def answerable(self) -> int:
        """How many queries have a true reference."""
        return sum(1 for true in self.truth if len(true))

    def first(self, count: int) -> "Dataset":
        """At most `count` queries, evenly spread over those with a true reference (all, for poses or sequences)."""
        rows = np.arange(len(self.queries))
        if not self.sequence and self.query_poses is None:
            rows = np.array([i for i in rows if len(self.truth[i])], np.int64)
        if not count or len(rows) <= count:
            return self
        return self.take(rows[np.linspace(0, len(rows) - 1, count).round().astype(int)])

    def take(self, rows: Sequence[int] | Indices) -> "Dataset":
        """The data set with only these queries."""
        return replace(
            self,
            queries=tuple(self.queries[i] for i in rows),
            truth=tuple(self.truth[i] for i in rows),
            excluded=None if self.excluded is None else tuple(self.excluded[i] for i in rows),
            conditions=tuple(self.conditions[i] for i in rows) if self.conditions else (),
            query_positions=None if self.query_positions is None else self.query_positions[np.asarray(rows)],
            stamps=None if self.stamps is None else self.stamps[np.asarray(rows)],
            query_poses=None if self.query_poses is None else self.query_poses[np.asarray(rows)],
            names=tuple(self.names[i] for i in rows) if self.names else (),
        )

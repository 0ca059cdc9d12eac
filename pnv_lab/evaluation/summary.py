"""The figures of a result, and tables of them as text, csv and JSON."""

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnv_lab.evaluation.datasets.seasons import TOLERANCES
from pnv_lab.evaluation.evaluate import MethodResult, localised
from pnv_lab.evaluation.metrics import (
    Interval,
    average_precision,
    bootstrap,
    first_hits,
    recall_at,
    recall_at_full_precision,
)

RECALLS = (1, 5, 10)


@dataclass(frozen=True)
class Figures:
    """Accuracy with 95 % intervals (bootstrap over queries) and cost of a method on a data set."""

    dataset: str
    method: str
    label: str
    condition: str  # "" for all queries
    queries: int  # that have a true reference
    recall: dict[int, Interval]
    average_precision: Interval
    full_precision_recall: Interval
    localised: tuple[float, ...]  # within TOLERANCES; empty without poses
    extraction_ms: float
    matching_ms: float
    reference_kb: float

    def as_dict(self) -> dict[str, Any]:
        """Flat, for csv and JSON."""
        row: dict[str, Any] = {
            "dataset": self.dataset,
            "method": self.method,
            "label": self.label,
            "condition": self.condition,
            "queries": self.queries,
        }
        intervals = {f"recall@{n}": interval for n, interval in self.recall.items()}
        intervals |= {"average_precision": self.average_precision, "recall@100precision": self.full_precision_recall}
        for name, interval in intervals.items():
            row |= {
                name: _rounded(interval.value),
                f"{name}_low": _rounded(interval.low),
                f"{name}_high": _rounded(interval.high),
            }
        for (metres, degrees), share in zip(TOLERANCES, self.localised, strict=False):
            row[f"within_{metres:g}m_{degrees:g}deg"] = _rounded(share)
        return row | {
            "extraction_ms": _rounded(self.extraction_ms, 2),
            "matching_ms": _rounded(self.matching_ms, 2),
            "reference_kb": _rounded(self.reference_kb, 2),
        }


def figures_of(result: MethodResult, samples: int = 1000) -> list[Figures]:
    """The figures over all queries, then one per condition where the data set names several."""
    conditions = result.dataset.conditions
    parts = [("", np.arange(len(result.rankings)))]
    if len(set(conditions)) > 1:
        parts += [(c, np.flatnonzero(np.array(conditions) == c)) for c in sorted(set(conditions))]
    return [_figures(result, condition, rows, samples) for condition, rows in parts]


def _figures(result: MethodResult, condition: str, rows: np.ndarray, samples: int) -> Figures:
    decisions = result.decisions.take(rows)
    hits = first_hits([result.rankings[i].references for i in rows], [result.dataset.truth[i] for i in rows])
    part = result
    if condition:
        taken = tuple(result.rankings[i] for i in rows)
        part = MethodResult(result.method, result.dataset.take(rows), taken, hits, decisions, 0.0, 0.0, 0.0)
    return Figures(
        result.dataset.name,
        result.method.name,
        result.method.label,
        condition,
        len(hits),
        {n: bootstrap(partial(_recall_of, hits, n), len(hits), samples) for n in RECALLS},
        bootstrap(lambda i: average_precision(decisions.take(i)), len(rows), samples),
        bootstrap(lambda i: recall_at_full_precision(decisions.take(i)), len(rows), samples),
        tuple(localised(part, TOLERANCES)),
        result.extraction_s * 1e3,
        result.matching_s * 1e3,
        result.reference_bytes / 1e3,
    )


def _recall_of(hits: NDArray[np.int64], n: int, rows: NDArray[np.int64]) -> float:
    return recall_at(hits[rows], n)


def recall_curve(result: MethodResult, depth: int) -> list[float]:
    """Recall@1 ... recall@depth."""
    return [recall_at(result.hits, n) for n in range(1, depth + 1)]


def paper_table(figures: Sequence[Figures]) -> str:
    """Methods as rows, data sets as columns, R@1, R@5 and R@10 in percent: the form of the paper's tables."""
    whole = [f for f in figures if not f.condition]
    datasets = list(dict.fromkeys(f.dataset for f in whole))
    labels = dict.fromkeys((f.method, f.label) for f in whole)
    cells = {(f.method, f.dataset): f for f in whole}
    width = max(len(label) for _, label in labels) + 2
    column = 20
    lines = [" " * width + "".join(f"{name[: column - 2]:^{column}}" for name in datasets)]
    lines.append(" " * width + "".join(f"{' R@1   R@5  R@10':^{column}}" for _ in datasets))
    for method, label in labels:
        row = f"{label:<{width}}"
        for name in datasets:
            cell = cells.get((method, name))
            text = "-" if cell is None else "".join(f"{_percent(cell.recall[n].value):>6}" for n in RECALLS)
            row += f"{text:^{column}}"
        lines.append(row.rstrip())
    return "\n".join(lines)


def detail_table(figures: Sequence[Figures]) -> str:
    """One line per method, data set and condition: intervals, decisions and cost."""
    header: tuple[str, ...] = (
        "data set",
        "method",
        "queries",
        "R@1 [95 %]",
        "AP [95 %]",
        "R@100%P",
        "extract ms",
        "match ms",
        "kB/ref",
    )
    poses = any(f.localised for f in figures)
    if poses:
        header += ("within .25m2 / .5m5 / 5m10",)
    rows: list[tuple[str, ...]] = [header]
    for f in figures:
        name = f"{f.dataset}, {f.condition}" if f.condition else f.dataset
        cost = (
            ("", "", "") if f.condition else (f"{f.extraction_ms:.1f}", f"{f.matching_ms:.1f}", f"{f.reference_kb:.1f}")
        )
        row = (
            name,
            f.label,
            str(f.queries),
            _with_interval(f.recall[1]),
            _with_interval(f.average_precision),
            _percent(f.full_precision_recall.value),
            *cost,
        )
        rows.append((*row, " / ".join(_percent(v) for v in f.localised)) if poses else row)
    widths = [max(len(row[i]) for row in rows) for i in range(len(header))]
    return "\n".join("  ".join(f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows)


def csv_text(figures: Sequence[Figures]) -> str:
    """Every figure as csv, one row per method, data set and condition."""
    rows = [f.as_dict() for f in figures]
    names = list(dict.fromkeys(name for row in rows for name in row))
    out = io.StringIO()
    writer = csv.DictWriter(out, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


def _with_interval(interval: Interval) -> str:
    return f"{_percent(interval.value)} [{_percent(interval.low)}, {_percent(interval.high)}]"


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{100 * value:.1f}"


def _rounded(value: float, digits: int = 6) -> float | None:
    return round(value, digits) if math.isfinite(value) else None

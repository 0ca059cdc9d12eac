"""The report: one HTML file with everything in it, readable on a phone and without a network."""

import base64
import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from pnv_core.drawing import draw_match
from pnv_core.images import read_image
from pnv_core.types import PatchMatches
from pnv_lab.evaluation.datasets.seasons import TOLERANCES
from pnv_lab.evaluation.evaluate import Evaluation, MethodResult
from pnv_lab.evaluation.extraction import descriptor_of
from pnv_lab.evaluation.metrics import precision_recall
from pnv_lab.evaluation.plots import Axis, Series, histogram, legend, line_chart, path_map, scatter
from pnv_lab.evaluation.summary import RECALLS, Figures, recall_curve

RIGHT, WRONG, MISSED = "#009e73", "#d55e00", "#56b4e9"
SHOWN = 4  # pictures of each kind; bounds the file to a few megabytes
PICTURE_SIZE = (320, 240)  # of each of the two images
_CURVE_DEPTH = 25
_BINS = 24

STYLE = """
:root{color-scheme:light dark;--ink:#1c2430;--soft:#5c6672;--paper:#fff;--line:#d7dce2;--panel:#f4f6f8}
@media(prefers-color-scheme:dark){:root{--ink:#e8ecf0;--soft:#a2adb8;--paper:#14181d;--line:#38414b;--panel:#1d232a}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.5 system-ui,-apple-system,"Segoe UI",sans-serif}
main{max-width:1120px;margin:0 auto;padding:16px}
h1{font-size:1.5rem;margin:.4em 0}
h2{font-size:1.25rem;margin:2em 0 .4em;border-top:2px solid var(--line);padding-top:.8em}
h3{font-size:1.02rem;margin:1.4em 0 .3em}p,dd{color:var(--soft)}code{font-size:.88em;overflow-wrap:anywhere}
dl{display:grid;grid-template-columns:max-content 1fr;gap:2px 12px;margin:.6em 0}dt{font-weight:600}dd{margin:0}
.wide{overflow-x:auto;border:1px solid var(--line);border-radius:8px}
table{border-collapse:collapse;width:100%;font-size:.86rem;font-variant-numeric:tabular-nums}
th,td{padding:6px 10px;text-align:right;white-space:nowrap;border-bottom:1px solid var(--line)}
tr:last-child td{border-bottom:0}
th{background:var(--panel);font-weight:600}
th:first-child,td:first-child{text-align:left;position:sticky;left:0;background:var(--paper);min-width:9.5em;max-width:46vw;
white-space:normal}
th:first-child{background:var(--panel)}td small{color:var(--soft)}td b{color:#0a7d5c}
@media(prefers-color-scheme:dark){td b{color:#4fd1a5}}
.charts{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,420px),1fr));gap:16px}
figure{margin:0;border:1px solid var(--line);border-radius:8px;padding:10px;background:var(--panel)}
figure svg,figure img{width:100%;height:auto;display:block}
svg{color:var(--soft)}details{margin:.4em 0}summary{cursor:pointer;font-weight:600}
figcaption{font-size:.8rem;color:var(--soft);margin-top:6px}
.legend span{display:inline-flex;align-items:center;margin-right:14px}
.legend i{width:12px;height:12px;border-radius:3px;margin-right:6px;display:inline-block}
.gallery{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,420px),1fr));gap:12px}
.gallery figure{border-left-width:5px}
"""


T = TypeVar("T")


@dataclass(frozen=True)
class Chapter:
    """The results of all methods on one data set."""

    results: Sequence[MethodResult]
    figures: Sequence[Figures]


def evaluation_report(evaluation: Evaluation, chapters: Sequence[Chapter], about: Sequence[tuple[str, str]]) -> str:
    """The whole report as HTML. `about` are names and values for its head, such as the command and the machine."""
    every = [f for chapter in chapters for f in chapter.figures]
    body = ["<h1>Place recognition report</h1>", about_lines(about), _summary(every)]
    for chapter in chapters:
        body.append(_chapter(evaluation, chapter))
    return page("Place recognition report", "".join(body))


def page(title: str, body: str) -> str:
    """A whole document around a body."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{STYLE}</style></head><body><main>{body}</main></body></html>\n"
    )


def about_lines(about: Sequence[tuple[str, str]]) -> str:
    """Names and values at the head of a report."""
    rows = (f"<dt>{html.escape(name)}</dt><dd><code>{html.escape(value)}</code></dd>" for name, value in about)
    return f"<dl>{''.join(rows)}</dl>"


def _summary(figures: Sequence[Figures]) -> str:
    """Methods as rows, data sets as columns, the best R@1 of each column in bold."""
    whole = [f for f in figures if not f.condition]
    datasets = list(dict.fromkeys(f.dataset for f in whole))
    methods = dict.fromkeys((f.method, f.label) for f in whole)
    cells = {(f.method, f.dataset): f for f in whole}
    best = {d: max((f.recall[1].value for f in whole if f.dataset == d), default=math.nan) for d in datasets}
    head = "".join(f"<th>{html.escape(d)}<br><small>R@1 / 5 / 10</small></th>" for d in datasets)
    rows = []
    for method, label in methods:
        row = f"<td>{html.escape(label)}</td>"
        for dataset in datasets:
            cell = cells.get((method, dataset))
            if cell is None:
                row += "<td>-</td>"
                continue
            first, *others = (_percent(cell.recall[n].value) for n in RECALLS)
            first = f"<b>{first}</b>" if cell.recall[1].value == best[dataset] else first
            row += f"<td>{first} / {' / '.join(others)}</td>"
        rows.append(f"<tr>{row}</tr>")
    table = f"<table><tr><th>method</th>{head}</tr>{''.join(rows)}</table>"
    return f'<h2>All methods, all data sets</h2><p>Recall in percent.</p><div class="wide">{table}</div>'


def _chapter(evaluation: Evaluation, chapter: Chapter) -> str:
    results = chapter.results
    dataset = results[0].dataset
    counted = f"{dataset.answerable} of {len(dataset.queries)} queries have a true reference"
    parts = [
        f"<h2>{html.escape(dataset.name)}</h2>",
        f"<p>{counted}, among {len(dataset.references)} references. True matches: {html.escape(dataset.rule)}.</p>",
        _one_size(evaluation, results),
        _details(chapter.figures),
        f'<div class="charts">{"".join(_charts(results))}{_matrix(evaluation, results[0])}{_trajectory(results)}</div>',
    ]
    shown = next((r for r in reversed(results) if r.method.scorer and r.method.features == "patchnetvlad"), results[-1])
    for result in (shown, *(r for r in results if r is not shown)):
        parts.append(_galleries(evaluation, result, opened=result is shown))
    return "".join(parts)


def _one_size(evaluation: Evaluation, results: Sequence[MethodResult]) -> str:
    """A word where a model of one patch size makes several methods the same."""
    multi = [r.method for r in results if r.method.sizes == "multi" and r.method.features == "patchnetvlad"]
    alone = [m for m in multi if len(evaluation.completed(m.config(evaluation.config)).patch_sizes) == 1]
    return "<p>The model has one patch size: Multi-* equals Single-*.</p>" if alone else ""


def _details(figures: Sequence[Figures]) -> str:
    poses = any(f.localised for f in figures)
    names = ["method", "R@1", "R@5", "R@10", "average precision", "recall at 100 % precision"]
    names += [f"{m:g} m, {d:g}°" for m, d in TOLERANCES] if poses else []
    names += ["describe ms", "match ms", "kB per reference"]
    rows = []
    for f in figures:
        intervals = [*(f.recall[n] for n in RECALLS), f.average_precision, f.full_precision_recall]
        label = f"{f.label}<br><small>{html.escape(f.condition)}</small>" if f.condition else html.escape(f.label)
        cells = [label]
        cells += [f"{_percent(i.value)}<br><small>{_percent(i.low)} - {_percent(i.high)}</small>" for i in intervals]
        cells += [_percent(v) for v in f.localised] if poses else []
        cost = (f.extraction_ms, f.matching_ms, f.reference_kb)
        cells += [""] * 3 if f.condition else [f"{v:.1f}" for v in cost]
        rows.append("<tr>" + "".join(f"<td>{c}</td>" for c in cells) + "</tr>")
    head = "".join(f"<th>{n}</th>" for n in names)
    note = "Percent; below each figure its 95 % interval (bootstrap over queries). Times are medians per query."
    return f'<div class="wide"><table><tr>{head}</tr>{"".join(rows)}</table></div><p><small>{note}</small></p>'


def _charts(results: Sequence[MethodResult]) -> list[str]:
    labels = [r.method.label for r in results]
    depth = min(_CURVE_DEPTH, max(len(k.references) for r in results for k in r.rankings))
    curves = [
        Series(name, [(n + 1, 100 * v) for n, v in enumerate(recall_curve(r, depth)) if not math.isnan(v)])
        for name, r in zip(labels, results, strict=True)
    ]
    lowest = min((p[1] for c in curves for p in c.points), default=0.0)
    charts = [
        "<div><h3>Recall@N</h3>" + line_chart(curves, Axis("N", 1, max(depth, 2)), _percent_axis("recall", lowest))
    ]
    charts[-1] += "</div>"
    decided = []
    for name, r in zip(labels, results, strict=True):
        _, precision, recall = precision_recall(r.decisions)
        kept: Sequence[int] = (
            np.unique(np.linspace(0, len(recall) - 1, 200).astype(int)).tolist() if len(recall) else []
        )
        decided.append(Series(name, [(100 * recall[i], 100 * precision[i]) for i in kept if np.isfinite(recall[i])]))
    axes = Axis("recall, %", 0, 100), Axis("precision, %", 0, 100)
    charts.append(f"<div><h3>Precision and recall of the best candidate</h3>{line_chart(decided, *axes)}</div>")
    spent = [(r.extraction_s + r.matching_s) * 1e3 for r in results]
    x = Axis("ms per query, describing and matching", max(min(spent) / 2, 0.01), max(max(spent) * 2, 0.1), log=True)
    points = [
        Series(name, [(ms, 100 * recall_curve(r, 1)[0])])
        for name, ms, r in zip(labels, spent, results, strict=True)
        if len(r.hits)
    ]
    if points:
        lowest = min(p.points[0][1] for p in points)
        charts.append(f"<div><h3>Time against recall</h3>{scatter(points, x, _percent_axis('R@1', lowest))}</div>")
    charts.append(_score_histogram(results[-1]))
    return charts


def _percent_axis(what: str, lowest: float) -> Axis:
    return Axis(f"{what}, %", max(0.0, math.floor(lowest / 10 - 0.5) * 10), 100)


def _score_histogram(result: MethodResult) -> str:
    """Scores of the best candidates, right and wrong ones, stacked."""
    decisions = result.decisions
    scores = decisions.scores[np.isfinite(decisions.scores)]
    right = decisions.right[np.isfinite(decisions.scores)]
    if not len(scores):
        return ""
    low, high = min(0.0, float(scores.min())), max(float(scores.max()), 1e-6)
    edges = np.linspace(low, high, _BINS + 1)
    groups = [
        (name, np.histogram(scores[mask], edges)[0].tolist()) for name, mask in (("right", right), ("wrong", ~right))
    ]
    chart = histogram(groups, Axis("score of the best candidate", low, high), (RIGHT, WRONG))
    return f"<div><h3>Scores, {html.escape(result.method.label)}</h3>{chart}</div>"


def _matrix(evaluation: Evaluation, result: MethodResult) -> str:
    matrix = evaluation.similarity_matrix(result.dataset, result.method)
    low, high = np.percentile(matrix, [1, 99.5])
    grey = ((matrix - low) / max(high - low, 1e-9)).clip(0, 1) * 255
    coloured = cv2.applyColorMap(grey.astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    scale = max(1, 480 // max(coloured.shape[:2]))
    big = cv2.resize(coloured, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
    caption = f"Cosine of the global vectors, {low:.2f} (dark) to {high:.2f}; queries down, references across."
    image = f'<img alt="similarity matrix" src="{data_uri(big, ".png")}">'
    return f"<div><h3>Similarity matrix</h3><figure>{image}<figcaption>{caption}</figcaption></figure></div>"


def _trajectory(results: Sequence[MethodResult]) -> str:
    """The path of a sequence with the best candidates of the last method, coloured by truth."""
    result = results[-1]
    dataset = result.dataset
    if not dataset.sequence or dataset.query_positions is None or len(dataset.queries) != len(dataset.references):
        return ""
    links, colours = [], []
    for q, ranking in enumerate(result.rankings):
        if len(ranking.references) and (len(dataset.truth[q]) or result.decisions.scores[q] > _largest_wrong(result)):
            links.append((q, int(ranking.references[0])))
            colours.append(RIGHT if result.decisions.right[q] else WRONG)
    flat, axes = flattened(dataset.query_positions)
    key = legend(("right", "wrong"), (RIGHT, WRONG))
    return f"<div><h3>Path and best candidates of revisits</h3>{path_map(flat, links, colours, axes, key)}</div>"


def _largest_wrong(result: MethodResult) -> float:
    wrong = result.decisions.scores[~result.decisions.right & np.isfinite(result.decisions.scores)]
    return float(wrong.max()) if len(wrong) else -math.inf


def flattened(positions: NDArray[np.float64]) -> tuple[list[tuple[float, float]], tuple[str, str]]:
    """(N, 3) -> the path along the two axes where it extends most, and their names."""
    a, b = sorted(np.argsort(-np.ptp(positions, axis=0), kind="stable")[:2])
    return [(float(p[a]), float(p[b])) for p in positions], ("xyz"[a], "xyz"[b])


def _galleries(evaluation: Evaluation, result: MethodResult, opened: bool) -> str:
    """Right matches, confident wrong ones, and missed places; folded and without right ones unless `opened`."""
    decisions = result.decisions
    answered = np.isfinite(decisions.scores)
    by_score = np.argsort(-decisions.scores, kind="stable")
    right = [q for q in by_score if answered[q] and decisions.right[q]]
    wrong = [q for q in by_score if answered[q] and not decisions.right[q]]
    missed = [q for q in by_score[::-1] if decisions.possible[q] and not decisions.right[q]]
    parts = [f"<summary>{html.escape(result.method.label)}: {len(right)} right, {len(wrong)} wrong</summary>"]
    for title, queries, colour in (
        ("Right: from the most to the least certain", spread(right) if opened else [], RIGHT),
        ("Wrong: the most certain first", wrong[:SHOWN], WRONG),
        ("Missed: the query beside its best true reference", missed[:SHOWN], MISSED),
    ):
        pictures = "".join(_picture(evaluation, result, int(q), colour) for q in queries)
        if pictures:
            parts.append(f'<h3>{title}</h3><div class="gallery">{pictures}</div>')
    return f"<details{' open' if opened else ''}>{''.join(parts)}</details>"


def spread(ranked: Sequence[T]) -> list[T]:
    """A few of a ranked list, from its first to its last."""
    if not ranked:
        return []
    return [ranked[i] for i in np.unique(np.linspace(0, len(ranked) - 1, SHOWN).round().astype(int))]


def _picture(evaluation: Evaluation, result: MethodResult, query: int, colour: str) -> str:
    """Query and reference side by side with their patch correspondences, as a figure."""
    dataset, method, ranking = result.dataset, result.method, result.rankings[query]
    reference = int(ranking.references[0])
    words = f"{'right' if colour == RIGHT else 'wrong'}, score {ranking.scores[0]:.3f}"
    if colour == MISSED:
        true = dataset.truth[query]
        listed = [(i, int(r)) for i, r in enumerate(ranking.references) if r in true]
        reference = listed[0][1] if listed else int(true[0])
        words = f"missed, ranked {listed[0][0] + 1}" if listed else "missed, not a candidate"
    paths = dataset.queries[query], dataset.references[reference]
    images = [read_image(p) for p in paths]
    matches: tuple[PatchMatches, ...] = ()
    size = PICTURE_SIZE
    if method.features == "patchnetvlad" and method.scorer:
        completed = evaluation.completed(method.config(evaluation.config))
        features = evaluation.describing(dataset, method, "patchnetvlad")
        keys = features.describe_all(list(paths), lambda items, *_: items)
        sizes = method.wanted_sizes(completed)
        pair = [descriptor_of(features.record(k, p), sizes, method.dim) for k, p in zip(keys, paths, strict=True)]
        matches = method.reranker(completed).score(*pair).matches
        size = completed.image_width, completed.image_height
    drawn = draw_match(images[0], images[1], matches, size, words)
    names = " ↔ ".join(html.escape(f"{p.parent.name}/{p.name}") for p in paths)
    image = f'<img loading="lazy" alt="{names}" src="{data_uri(fitted(drawn))}">'
    return f'<figure style="border-left-color:{colour}">{image}<figcaption>{names}</figcaption></figure>'


def fitted(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """At most as wide as two pictures, as BGR."""
    scale = min(1.0, 2 * PICTURE_SIZE[0] / rgb.shape[1])
    small = cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else rgb
    return cv2.cvtColor(small, cv2.COLOR_RGB2BGR).astype(np.uint8)


def data_uri(bgr: NDArray, suffix: str = ".jpg") -> str:
    """An image inside the page itself."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, 80] if suffix == ".jpg" else []
    _, encoded = cv2.imencode(suffix, bgr, quality)
    kind = "jpeg" if suffix == ".jpg" else "png"
    return f"data:image/{kind};base64,{base64.b64encode(encoded.tobytes()).decode()}"


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{100 * value:.1f}"

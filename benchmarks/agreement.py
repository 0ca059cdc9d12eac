"""What the faster modes change on real images: recall@1, mutual matches, winners.

python -m benchmarks.agreement DATA [--queries N] [--out FILE]

DATA holds folders with matches.csv (query, true_refs), as ../shared/data. Images are described by the default model at
its own size, with patches 2, 5, 8 in the 512 dimensions of its global projection (D=512) or the first 128 of them.
"""

import argparse
import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnv_core import load_describer
from pnv_core.config import Config
from pnv_core.describe.describer import Describer
from pnv_core.describe.model_files import Model
from pnv_core.files import atomic_write
from pnv_core.images import read_image
from pnv_core.types import PatchGrid, PlaceDescriptor
from pnv_core.verify.matching import mutual_nearest
from pnv_core.verify.reranker import Reranker

SIZES, WEIGHTS = (2, 5, 8), (0.45, 0.15, 0.4)
MODES = {
    "exact": {},
    "bfloat16 trunk": {"trunk_precision": "bfloat16"},
}


def describer_of(threads: int, **settings: str) -> Describer:
    """The default model whose patches share the global projection."""
    default = load_describer(threads=threads)
    shared = {name: t for name, t in default.model.tensors.items() if not name.startswith("patch_projection.")}
    config = Config.make(patch_sizes=SIZES, patch_strides=(1, 1, 1), patch_weights=WEIGHTS, threads=threads, **settings)
    return Describer(Model(default.model.info, shared), config)


def described(describer: Describer, paths: list[Path]) -> list[PlaceDescriptor]:
    return [describer.describe(read_image(p)) for p in paths]


def stored(descriptor: PlaceDescriptor, dim: int, precision: str) -> PlaceDescriptor:
    """The first `dim` dimensions, unit, as the database would keep them."""
    grids = []
    for grid in descriptor.patches:
        rows = grid.descriptors[:, :dim].astype(np.float32)
        rows = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
        if precision == "float16":
            rows = rows.astype(np.float16)
        if precision == "int8":
            scale = np.abs(rows).max(1, keepdims=True) / 127
            rows = (np.rint(rows / np.where(scale > 0, scale, 1)) * scale).astype(np.float32)
        grids.append(PatchGrid(grid.size, grid.rows, grid.cols, rows))
    return replace(descriptor, patches=tuple(grids))


def reranker_of(scorer: str, threads: int) -> Reranker:
    return Reranker(
        Config.make(
            patch_sizes=SIZES,
            patch_strides=(1, 1, 1),
            patch_weights=WEIGHTS,
            scorer=scorer,
            threads=threads,
        )
    )


def winners(
    reranker: Reranker, queries: list[PlaceDescriptor], references: list[PlaceDescriptor], ranking: NDArray[np.int64]
) -> NDArray[np.int64]:
    """(Q,) the reference each query likes best among its candidates (Q, k)."""
    best = []
    for query, candidates in zip(queries, ranking, strict=True):
        results = reranker.scores(query, [references[i] for i in candidates])
        best.append(candidates[int(np.argmax([r.score for r in results]))])
    return np.array(best)


def examined(folder: Path, count: int, candidates: int, threads: int) -> dict:
    with open(folder / "matches.csv", newline="") as file:
        rows = [(row["query"], set(row["true_refs"].split(";"))) for row in csv.DictReader(file)]
    rows = rows[:: max(1, len(rows) // count)][:count]
    wanted = sorted(set().union(*(true for _, true in rows)))
    names = wanted[:: max(1, len(wanted) // (2 * count))]
    names = sorted(set(names) | {next(iter(sorted(true))) for _, true in rows})
    truth = np.array([[name in true for name in names] for _, true in rows])
    found: dict = {"queries": len(rows), "references": len(names), "recall@1": {}, "same winner as exact": {}}
    exact: tuple = ()
    for mode, settings in MODES.items():
        describer = describer_of(threads, **settings)
        queries = described(describer, [folder / query for query, _ in rows])
        references = described(describer, [folder / name for name in names])
        vectors = [np.stack([d.global_vector for d in side]) for side in (queries, references)]
        ranking = np.argsort(-(vectors[0] @ vectors[1].T), axis=1, kind="stable")[:, :candidates]
        best = winners(reranker_of("rapid", threads), queries, references, ranking)
        found["recall@1"][mode] = int(truth[np.arange(len(rows)), best].sum())
        if mode == "exact":
            exact = queries, references, ranking, best
            continue
        pairs = list(zip(queries + references, exact[0] + exact[1], strict=True))
        found[mode] = {
            "worst 1 - cosine of global vectors": max(1 - float(a.global_vector @ b.global_vector) for a, b in pairs),
            "worst 1 - cosine of patches": max(
                float((1 - (g.descriptors * h.descriptors).sum(1)).max())
                for a, b in pairs
                for g, h in zip(a.patches, b.patches, strict=True)
            ),
            "share of exact mutual matches kept": kept_matches(queries, references, exact, ranking),
        }
    queries, references, ranking, _ = exact
    for dim, scorer in ((512, "rapid"), (128, "ransac")):
        reduced = [[stored(d, dim, "float32") for d in side] for side in (queries, references)]
        best = winners(reranker_of(scorer, threads), *reduced, ranking)
        for precision in ("float16", "int8"):
            kept = [stored(d, dim, precision) for d in references]
            other = winners(reranker_of(scorer, threads), reduced[0], kept, ranking)
            found["same winner as exact"][f"{precision} stored, {scorer}, D={dim}"] = int((best == other).sum())
    return found


def kept_matches(
    queries: list[PlaceDescriptor], references: list[PlaceDescriptor], exact: tuple, ranking: NDArray[np.int64]
) -> float:
    """Share of the mutual matches of each query with its first candidate that both descriptions find."""
    kept = total = 0
    for number, candidates in enumerate(ranking):
        pairs = zip(
            queries[number].patches,
            references[candidates[0]].patches,
            exact[0][number].patches,
            exact[1][candidates[0]].patches,
            strict=True,
        )
        for q, r, q0, r0 in pairs:
            given = set(zip(*map(tuple, mutual_nearest(q.descriptors, r.descriptors)), strict=True))
            expected = set(zip(*map(tuple, mutual_nearest(q0.descriptors, r0.descriptors)), strict=True))
            kept, total = kept + len(given & expected), total + len(expected)
    return kept / max(total, 1)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--queries", type=int, default=60, help="of each set")
    parser.add_argument("--candidates", type=int, default=30)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--sets", nargs="*", default=[], help="names of folders; all with matches.csv if none")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    folders = sorted(p.parent for p in args.data.glob("*/matches.csv") if not args.sets or p.parent.name in args.sets)
    report = {}
    for folder in folders:
        report[folder.name] = examined(folder, args.queries, args.candidates, args.threads)
        print(folder.name, json.dumps(report[folder.name]), flush=True)
    if args.out:
        with atomic_write(args.out) as file:
            file.write((json.dumps(report, indent=1) + "\n").encode())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

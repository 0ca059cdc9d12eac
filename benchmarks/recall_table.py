"""Recall of the default model beside plain baselines: on the sets choices are made on, and on those that judge them.

    python benchmarks/recall_table.py dev --data ../shared/data --train ../shared/train --imagenet LITE.pth
    python benchmarks/recall_table.py report --data ../shared/data --train ../shared/train

`dev`: viewpoint_places, pepper_s11 and what training held out of the tower and the panoramas (asked for by augmented
views of its own images). `report`: webcams, essex, gardens and donkey; every look at them is counted in the model card.
"patches" ranks by the spatial score alone (the paper), "re-ranked" by all evidence, as the recogniser does, but for
local features. Baselines: the untrained trunk with GeM and with NetVLAD from k-means (no PCA), dense RootSIFT VLAD,
each with a vocabulary fitted to the training photographs. Intervals are Wilson's, 95 %. Queries are drawn by --seed.
`--methods fitted`: the default model as `pnv fit` adapts it to each set's references.
"""

import argparse
import json
import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from pnv_core.config import Config
from pnv_core.decide.judge import Judge
from pnv_core.describe.describer import Describer, describer_from, resized
from pnv_core.describe.netvlad import NetVLAD, gem
from pnv_core.describe.torch_model import TorchModel, TorchTrunk
from pnv_core.describe.trunks.rootsift import rootsift_trunk
from pnv_core.types import ImageRef, PlaceDescriptor
from pnv_lab.fit import FitOptions, adapt_model, as_batch, image_files, read_rgb, vocabulary_of
from pnv_lab.training.initial import imagenet_trunk
from pnv_lab.training.sources import is_held, load_set
from pnv_lab.training.validation import synthetic_queries

SIZE = (320, 240)
RECALLS = (1, 5, 10)
Pixels = NDArray[np.uint8]
Head = Callable[[torch.Tensor], torch.Tensor]
DEV = ("viewpoint_places", "pepper_s11")
REPORT = ("webcams_daynight", "essex3in1_thumbs", "gardens_point_thumbs", "donkey_desks_laps")
# recall@1 on viewpoint_places with all references, from the set's README (matches stored in its source repository).
PUBLISHED = {"NetVLAD, published": 60.0, "RegionVLAD, published": 27.3, "HybridNet, published": 24.5,
             "AMOSNet, published": 23.6, "CoHOG, published": 22.7, "AlexNet, published": 10.9}  # fmt: skip
DONKEY_EXCLUDED = 50  # raw frames a loop must be apart (the set's README)
DONKEY_TOLERANCE = 20  # raw frames (1 s) around a true reference that count neither way


@dataclass(frozen=True, eq=False)
class RecallSet:
    """truth and counted are (Q, R): one place; and whether the pair may be scored at all."""

    name: str
    queries: list[Path | Pixels]
    references: list[Path | Pixels]
    truth: NDArray[np.bool_]
    counted: NDArray[np.bool_]


def paired(folder: Path, queries: str, references: str) -> RecallSet:
    """A folder with matches.csv and query and reference images in folders of their own."""
    rows = _matches(folder)
    found = sorted((folder / references).iterdir())
    number = {f"{references}/{p.name}": i for i, p in enumerate(found)}
    truth = np.zeros((len(rows), len(found)), bool)
    for row, (_, true) in enumerate(rows):
        truth[row, [number[t] for t in true]] = True
    return RecallSet(folder.name, [folder / q for q, _ in rows], found, truth, np.ones_like(truth))


def within_a_step(whole: RecallSet) -> RecallSet:
    """The same with the frames next to a true one counted as true, as Gardens Point's benchmark does."""
    truth = whole.truth.copy()
    truth[:, 1:] |= whole.truth[:, :-1]
    truth[:, :-1] |= whole.truth[:, 1:]
    return replace(whole, name=f"{whole.name}, 1 frame", truth=truth)


def laps(folder: Path) -> RecallSet:
    """donkey_desks_laps: earlier frames are the references; near misses count neither way."""
    rows = _matches(folder)
    found = sorted((folder / "images").iterdir())
    frame = np.array([int(p.stem) for p in found])
    truth = np.zeros((len(rows), len(found)), bool)
    counted = np.zeros_like(truth)
    for row, (query, true) in enumerate(rows):
        truth[row] = np.isin(frame, [int(Path(t).stem) for t in true])
        near = (np.abs(frame[:, None] - frame[truth[row]]) <= DONKEY_TOLERANCE).any(1)
        counted[row] = (int(Path(query).stem) - frame > DONKEY_EXCLUDED) & (truth[row] | ~near)
    return RecallSet(folder.name, [folder / "images" / q for q, _ in rows], found, truth, counted)


def synthetic(folder: Path, queries: int, seed: int, held: bool) -> RecallSet:
    """A training set, or what is held out of it: images as they are, asked for by their augmented views."""
    images = [i for i in load_set(folder) if not i.panorama and is_held(i) == held]
    known = synthetic_queries(folder.name, images, SIZE, queries, seed)
    name = f"{folder.name}, {'held out' if held else 'trained on'}"
    return RecallSet(name, list(known.queries), list(known.references), known.true, known.counted)


def _matches(folder: Path) -> list[tuple[str, list[str]]]:
    lines = (folder / "matches.csv").read_text().split("\n")[1:]
    return [(line.split(",")[0], line.split(",")[1].strip().split(";")) for line in lines if line]


def thinned(whole: RecallSet, queries: int, references: int, seed: int) -> RecallSet:
    """At most so many queries and references, drawn by seed; every query keeps a true reference."""
    rng = random.Random(seed)
    rows = sorted(rng.sample(range(len(whole.queries)), min(queries, len(whole.queries))))
    needed = {int(rng.choice(np.flatnonzero(whole.truth[row] & whole.counted[row]))) for row in rows}
    others = [i for i in range(len(whole.references)) if i not in needed]
    columns = sorted(needed | set(rng.sample(others, max(0, min(references - len(needed), len(others))))))
    grid = np.ix_(rows, columns)
    return RecallSet(
        whole.name,
        [whole.queries[r] for r in rows],
        [whole.references[c] for c in columns],
        whole.truth[grid],
        whole.counted[grid],
    )


def recalls(order: NDArray[np.int64], truth: NDArray[np.bool_]) -> list[float]:
    hits = np.take_along_axis(truth, order, 1)
    return [100 * float(hits[:, :n].any(1).mean()) for n in RECALLS]


def interval(share: float, count: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share in percent."""
    p, z = share / 100, 1.96
    middle, half = p + z * z / (2 * count), z * np.sqrt(p * (1 - p) / count + z * z / (4 * count * count))
    return tuple(100 * (middle + s * half) / (1 + z * z / count) for s in (-1, 1))  # type: ignore[return-value]


def ranked(queries: NDArray, references: NDArray, counted: NDArray[np.bool_]) -> NDArray[np.int64]:
    similarity = np.where(counted, queries @ references.T, -np.inf)
    return np.argsort(-similarity, axis=1, kind="stable")


@torch.inference_mode()
def baseline_vectors(trunk: TorchTrunk, heads: dict[str, Head], images: Sequence[Path | Pixels]) -> dict[str, NDArray]:
    found: dict[str, list[NDArray]] = {name: [] for name in heads}
    for image in images:
        features = trunk(as_batch([pixels(image, SIZE)])).float()
        for name, head in heads.items():
            found[name].append(head(features)[0].numpy())
    return {name: np.stack(rows) for name, rows in found.items()}


def pixels(image: Path | Pixels, size: tuple[int, int]) -> Pixels:
    return read_rgb(image, *size) if isinstance(image, Path) else resized(image, *size)


def fitted(trunk: TorchTrunk, files: Sequence[Path]) -> NetVLAD:
    with torch.inference_mode():
        maps = (trunk(as_batch([read_rgb(f, *SIZE)])) for f in files)
        return vocabulary_of(maps, FitOptions(clusters=16, cells_per_image=60))


def baselines(args: argparse.Namespace) -> list[tuple[TorchTrunk, dict[str, Head]]]:
    """Trunks and what is made of their maps, vocabularies fitted to some of the training photographs."""
    sample = image_files([args.train])
    sample = sorted(random.Random(args.seed).sample(sample, min(200, len(sample))))
    found: list[tuple[TorchTrunk, dict[str, Head]]] = []
    if args.imagenet and "untrained" in args.methods.split(","):
        trunk = imagenet_trunk(args.imagenet, 0)
        found.append((trunk, {"untrained, GeM": gem, "untrained, NetVLAD k-means": fitted(trunk, sample)}))
    if "rootsift" in args.methods.split(","):
        sift = TorchTrunk(rootsift_trunk())
        found.append((sift, {"dense RootSIFT VLAD": fitted(sift, sample)}))
    return found


def with_default(describer: Describer, known: RecallSet, depth: int) -> list[tuple[str, list[float]]]:
    """The default model before and after re-ranking its first `depth`: by the spatial score, and by all evidence."""
    queries, references = (described(describer, part) for part in (known.queries, known.references))
    found = orders(describer, queries, references, known, depth)
    return [(f"default, {name}", recalls(order, known.truth)) for name, order in found.items()]


def described(describer: Describer, images: Sequence[Path | Pixels]) -> list[PlaceDescriptor]:
    """Patches in half precision, as the database keeps them."""
    return [_slim(describer.describe(pixels(image, describer.image_size))) for image in images]


def orders(
    describer: Describer,
    queries: list[PlaceDescriptor],
    references: list[PlaceDescriptor],
    known: RecallSet,
    depth: int,
) -> dict[str, NDArray[np.int64]]:
    """The references of each query, best first: globally; of the first `depth` by patches, and by all evidence."""
    vectors = [np.stack([d.global_vector for d in part]) for part in (queries, references)]
    order = ranked(*vectors, known.counted)
    config = describer.config.replace(verify=0)
    judge = Judge(config, describer.model.info.calibration)
    spatial, better = order.copy(), order.copy()
    for row, query in enumerate(queries):
        head = [int(c) for c in order[row, :depth] if known.counted[row, c]]
        found = [(ImageRef(c, 0, ""), float(query.global_vector @ references[c].global_vector)) for c in head]
        judged = judge.judge(ImageRef(-1, 0, ""), query, 1.0, found, [references[c] for c in head], config)
        better[row, : len(head)] = [closure.match.id for closure in judged]
        spatial[row, : len(head)] = [c.match.id for c in sorted(judged, key=lambda c: -c.spatial)]
    return {"global": order, "patches": spatial, "re-ranked": better}


def with_fitted(describer: Describer, known: RecallSet) -> list[tuple[str, list[float]]]:
    """The global vector of the default model as `pnv fit` adapts it to the set's references, pairs by name."""
    files = [image for image in known.references if isinstance(image, Path)]
    if len(files) < len(known.references):
        return []
    model = adapt_model(TorchModel.of(describer.model), files).model()
    fitted = Describer(model, describer.config)
    vectors = [
        np.stack([fitted.describe(pixels(image, fitted.image_size)).global_vector for image in part])
        for part in (known.queries, known.references)
    ]
    return [("default, fitted, global", recalls(ranked(*vectors, known.counted), known.truth))]


def opened(args: argparse.Namespace) -> Iterator[RecallSet]:
    for name in DEV if args.part == "dev" else REPORT:
        folder = args.data / name
        if name == "donkey_desks_laps":
            whole = laps(folder)
        else:
            whole = paired(folder, *(("query_night", "ref_day") if name == "webcams_daynight" else ("query", "ref")))
        whole = whole if name == "viewpoint_places" else thinned(whole, args.queries, args.references, args.seed)
        yield whole
        if name == "gardens_point_thumbs":
            yield within_a_step(whole)
    for name in ("ie_tower", "polyhaven_hdri") if args.part == "dev" else ():
        yield synthetic(args.train / name, args.queries, args.seed, held=True)


def _slim(descriptor: PlaceDescriptor) -> PlaceDescriptor:
    slim = tuple(replace(p, descriptors=p.descriptors.astype(np.float16)) for p in descriptor.patches)
    return replace(descriptor, patches=slim)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("dev", "report"))
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--train", type=Path, required=True)
    parser.add_argument("--imagenet", type=Path, help="EfficientNet-Lite0 weights for the untrained baselines")
    parser.add_argument("--weights", default="default")
    parser.add_argument("--methods", default="untrained,rootsift,default")
    parser.add_argument("--queries", type=int, default=100)
    parser.add_argument("--references", type=int, default=400)
    parser.add_argument("--depth", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    plain = baselines(args)
    describer = None
    methods = args.methods.split(",")
    if {"default", "fitted"} & set(methods):
        describer = describer_from(Config.make(weights=args.weights, threads=args.threads))
    table = []
    print(f"{'set':34}{'queries':>8}  {'method':28}" + "".join(f"{f'R@{n}':>7}" for n in RECALLS) + "   R@1, 95 %")
    for known in opened(args):
        rows: list[tuple[str, list[float]]] = []
        for trunk, heads in plain:
            q, r = (baseline_vectors(trunk, heads, images) for images in (known.queries, known.references))
            rows += [(h, recalls(ranked(q[h], r[h], known.counted), known.truth)) for h in heads]
        if describer is not None:
            rows += with_default(describer, known, args.depth) if "default" in methods else []
            rows += with_fitted(describer, known) if "fitted" in methods else []
        if known.name == "viewpoint_places":
            rows += [(method, [share]) for method, share in PUBLISHED.items()]
        for method, found in rows:
            low, high = interval(found[0], len(known.queries))
            figures = {f"recall@{n}": round(v, 1) for n, v in zip(RECALLS, found, strict=False)}
            table.append({"set": known.name, "queries": len(known.queries), "method": method} | figures)
            print(
                f"{known.name:34}{len(known.queries):8}  {method:28}"
                + "".join(f"{v:7.1f}" for v in found).ljust(21)
                + f"   {low:.0f} to {high:.0f}",
                flush=True,
            )
    if args.json:
        args.json.write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()

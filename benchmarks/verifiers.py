"""Local features that could verify closures, compared on the same candidates.

    python -m benchmarks.verifiers --shared ../shared [--queries 30] [--methods rootsift-320-500,xfeat-640-500-ratio]

A method is FEATURES-WIDTH-MOST[-MATCHER[-GEOMETRY]]: rootsift (Lowe's ratio .8), xfeat with mutual (mutual nearest
neighbours), cosine (at least .82, as its authors), ratio (.9 in both images) or lighterglue, aliked (with LightGlue).
Every query's five candidates are the most similar by the default model's global vector; inliers of one geometry are the
score: of a fundamental matrix, or magsac (the same by MAGSAC), homography, essential (a lens of 60 degrees is assumed),
both (a homography or a fundamental matrix, whichever more points agree on).

recall@100%: queries of all sets together whose true candidate has more inliers than any false candidate of any set.
first: the true image first on viewpoint_places, by similarity alone and with log(1 + inliers) / 5 added. LightGlue and
LighterGlue need the extra `lightglue`.
"""

import argparse
import contextlib
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.closure_sets import FALSE, NARROW, TRUE, TruthSequence, sequence
from benchmarks.closures import small_motion
from pnv_core.describe.describer import load_describer
from pnv_core.verify.feature_codes import pack
from pnv_core.verify.local_features import LocalFeatures, match, no_features
from pnv_core.verify.xfeat import XFeat
from pnv_lab.evaluation.local_features import lighterglue, lightglue_parts, ratio_matches

SETS = ("webcams", "pepper", "donkey", "icl", "viewpoint", "essex", "multifloor", "kitti03")
CANDIDATES = 5
METHODS = (
    "rootsift-320-500",
    *(f"xfeat-{width}-500-ratio" for width in (320, 480, 640)),
    *(f"xfeat-640-{most}-ratio" for most in (300, 1000)),
    *(f"xfeat-640-500-{matcher}" for matcher in ("mutual", "cosine", "lighterglue")),
    "aliked-480-500",
    "aliked-640-500",
)
Grey = NDArray[np.uint8]
Pairs = tuple[NDArray[np.int64], NDArray[np.int64]]


@dataclass(frozen=True, eq=False)
class Query:
    """A query image of a set and its candidates: (image, similarity, label)."""

    images: TruthSequence
    number: int
    loop: bool
    candidates: list[tuple[int, float, int]]


def queries_of(name: str, shared: Path, most: int) -> list[Query]:
    """Queries spread over the set, each with its most similar images among those that may be matched."""
    images, describer = sequence(name, shared), load_describer()
    counted = np.ones(len(images), bool) if images.queries is None else images.queries
    first = images.starts[0] if images.starts else 0
    numbers = [i for i in np.flatnonzero(counted) if i >= first and _older(images, int(i)).any()]
    chosen = [int(numbers[i]) for i in np.unique(np.linspace(0, len(numbers) - 1, min(most, len(numbers))).astype(int))]
    step = max(1, len(images) // 300)
    pool = sorted({*range(0, len(images), step), *chosen})
    vectors = {i: describer.describe(images.read(i)).global_vector for i in pool}
    found = []
    for query in chosen:
        allowed = [i for i in pool if i % step == 0 and i != query and _older(images, query)[i]]
        ranked = sorted(allowed, key=lambda i: -float(vectors[i] @ vectors[query]))[:CANDIDATES]
        known = [(i, float(vectors[i] @ vectors[query]), _label(images, name, query, i)) for i in ranked]
        found.append(Query(images, query, any(images.truth(query, i) == TRUE for i in allowed), known))
    return found


def _older(images: TruthSequence, query: int) -> NDArray[np.bool_]:
    if images.starts:
        return np.arange(len(images)) < images.starts[0]
    return images.stamps <= images.stamps[query] - images.exclude_recent_s


def _label(images: TruthSequence, name: str, query: int, other: int) -> int:
    label = images.truth(query, other)
    near = label == FALSE and name in NARROW and small_motion(images.read(query), images.read(other))
    return -1 if near else label


class Method:
    """One way to find and match features. `describe` a grey picture, `match` two of what it gave."""

    def __init__(self, name: str) -> None:
        features, width, most, *rest = name.split("-")
        self.name, self.width, self.most = name, int(width), int(most)
        self.matcher, self.geometry = (*rest, *(features, "fundamental")[len(rest) :])
        self._network: Any = None
        self._glue: Callable[[Any, Any], Pairs] | None = None
        if features == "xfeat":
            self._network = XFeat(self.width, self.most, threads=2)
            self._glue = lighterglue() if self.matcher == "lighterglue" else None
        elif features == "aliked":
            self._network, self._glue = lightglue_parts(self.most, "cpu")

    def describe(self, grey: Grey) -> tuple[LocalFeatures, Any]:
        """Features in units of the width, and what the glue wants of them."""
        if self.matcher == "rootsift":
            return _rootsift(grey, self.width, self.most), None
        if self.matcher == "aliked":
            size = self.width, round(self.width * grey.shape[0] / grey.shape[1])
            found = self._network(np.repeat(cv2.resize(grey, size)[:, :, None], 3, axis=2))
            return LocalFeatures(found["keypoints"] / self.width, found["descriptors"]), found
        features = self._network.features(grey)
        return features, (features, grey.shape[0] / grey.shape[1])

    def match(self, query: tuple[LocalFeatures, Any], reference: tuple[LocalFeatures, Any]) -> Pairs:
        if self._glue is not None:
            return self._glue(query[1], reference[1])
        one, other = query[0], reference[0]
        if self.matcher == "rootsift":
            q, r = ratio_matches(one.descriptors, other.descriptors)
            back = dict(zip(*ratio_matches(other.descriptors, one.descriptors), strict=True))
            mutual = np.array([back.get(j) == i for i, j in zip(q, r, strict=True)], bool)
            return q[mutual], r[mutual]
        q, r, distinct, _ = match(one, other)
        if self.matcher == "ratio":
            return q[distinct], r[distinct]
        sure = (one.descriptors[q] * other.descriptors[r]).sum(1) > (0.82 if self.matcher == "cosine" else -1)
        return q[sure], r[sure]

    def size(self, features: LocalFeatures) -> int:
        """Bytes a keyframe: as XFeat's are kept; of the others one byte a number, and the place in two u16."""
        if features.descriptors.shape[1] == 64:
            return len(pack(features.points, features.descriptors, 1.0))
        return len(features.points) * (4 + features.descriptors.shape[1])


def _rootsift(grey: Grey, width: int, most: int) -> LocalFeatures:
    height = max(1, round(width * grey.shape[0] / grey.shape[1]))
    picture = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
    keypoints, descriptors = cv2.SIFT.create(most, contrastThreshold=0.02).detectAndCompute(picture, None)
    if descriptors is None:
        return no_features(128)
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-6))
    return LocalFeatures(np.array([k.pt for k in keypoints], np.float32) / width, root.astype(np.float32))


def inliers(a: NDArray[np.float32], b: NDArray[np.float32], geometry: str) -> int:
    """Of one geometry of matched points (M, 2), pixels: within 1.5, of a homography within 3."""
    if geometry == "both":
        return max(inliers(a, b, one) for one in ("homography", "fundamental"))
    mask: Any = None
    if len(a) >= 8:
        with contextlib.suppress(cv2.error):
            if geometry == "homography":
                _, mask = cv2.findHomography(a, b, cv2.USAC_ACCURATE, 3.0, maxIters=1000, confidence=0.999)
            elif geometry == "essential":
                centre = np.concatenate([a, b]).max(0) / 2
                camera = np.array([[1.75 * centre[0], 0, centre[0]], [0, 1.75 * centre[0], centre[1]], [0, 0, 1]])
                _, mask = cv2.findEssentialMat(a, b, camera, cv2.USAC_ACCURATE, 0.999, 1.5, 1000)
            else:
                way = cv2.USAC_MAGSAC if geometry == "magsac" else cv2.USAC_ACCURATE
                _, mask = cv2.findFundamentalMat(a, b, way, 1.5, 0.999, 1000)
    return 0 if mask is None else int((mask > 0).sum())


def row(method: Method, queries: dict[str, list[Query]]) -> str:
    """What the method does on every set."""
    extract_ms: list[float] = []
    match_ms: list[float] = []
    sizes: list[int] = []
    best: list[tuple[int, int]] = []  # inliers of the best true candidate where there is a loop, of the best false one
    first = [0, 0]
    for name, found in queries.items():
        known: dict[int, tuple[LocalFeatures, Any]] = {}
        for query in found:
            for number in (query.number, *(number for number, _, _ in query.candidates)):
                if number not in known:
                    grey: Any = cv2.cvtColor(query.images.read(number), cv2.COLOR_RGB2GRAY)
                    start = time.perf_counter()
                    known[number] = method.describe(grey)
                    extract_ms.append(1e3 * (time.perf_counter() - start))
                    sizes.append(method.size(known[number][0]))
            counts = []
            for number, _, _ in query.candidates:
                start = time.perf_counter()
                pairs = method.match(known[query.number], known[number])
                sides = zip((known[query.number][0], known[number][0]), pairs, strict=True)
                a, b = (features.points[chosen] * method.width for features, chosen in sides)
                counts.append(inliers(a, b, method.geometry))
                match_ms.append(1e3 * (time.perf_counter() - start))
            labels = [label for _, _, label in query.candidates]
            labelled = list(zip(counts, labels, strict=True))
            true, false = (max((c for c, label in labelled if label == t), default=-1) for t in (TRUE, FALSE))
            best.append((true if query.loop else -2, false))
            if name == "viewpoint":
                similar = [similarity for _, similarity, _ in query.candidates]
                summed = [s + math.log1p(c) / 5 for s, c in zip(similar, counts, strict=True)]
                first[0] += labels[int(np.argmax(similar))] == TRUE
                first[1] += labels[int(np.argmax(summed))] == TRUE
    bar = max(false for _, false in best)
    loops = [true for true, _ in best if true > -2]
    shown = len(queries.get("viewpoint", ()))
    recall = np.mean([t > bar for t in loops])
    costs = f"{np.median(extract_ms):9.1f} {np.median(match_ms):7.1f} {np.median(sizes):8.0f}"
    return f"{method.name:<26} {recall:11.3f} (> {bar:3d}) {first[0]:4d} {first[1]:5d} of {shown:3d} {costs}"


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path("../shared"))
    parser.add_argument("--queries", type=int, default=30, help="of every set")
    parser.add_argument("--methods", default=",".join(METHODS))
    args = parser.parse_args(argv)
    queries = {name: queries_of(name, args.shared, args.queries) for name in SETS}
    print(f"{'method':<26} {'recall@100%':>11} (bar)   first: similarity, with it   extract ms  pair ms    bytes")
    for name in args.methods.split(","):
        print(row(Method(name), queries), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())

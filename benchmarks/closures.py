"""Closures on sequences of known truth: fit the calibration, and judge score and consistency.

    python -m benchmarks.closures fit  --shared ../shared [--weights MODEL] [--write]
    python -m benchmarks.closures judge --shared ../shared [--weights MODEL] [--plot OUT.png] [NAMES]

`fit` uses the sets that may train a shipped model and writes the calibration into the model file; `judge` reports
on the others. Descriptors are kept in a cache folder by the model's fingerprint and precision.
"""

import argparse
import math
import sys
import tempfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.closure_sets import FALSE, FIT, JUDGE, NARROW, TRUE, TruthSequence, sequence
from pnv_core.config import Config
from pnv_core.decide.calibration import Calibration, Logistic, fit_calibration, reliability, write_calibration
from pnv_core.describe.describer import Describer, describer_from
from pnv_core.describe.download import resolve_weights
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.types import Evidence, LoopClosure, PatchGrid, PlaceDescriptor
from pnv_core.verify.local_features import MOST, WIDTH
from pnv_core.verify.verifier import Verifier
from pnv_lab.evaluation.local_features import ratio_matches, sift_record

NEAR = 2  # false by a ground truth that is too narrow, and a small motion by geometry: neither right nor wrong
ALIKE = "tower"  # no look, however close, tells its floors apart
CAUTION = 0.7  # what a false candidate counts in the fit: a fifth of it is a tower of floors that nobody tells apart
CLOSER_CAUTION = 0.6  # the same of the closer look: what it finds falsely is mostly one street from farther along


class RememberedDescriber:
    """A describer that knows the images of one sequence by heart, once it has seen them. `at` is the image's number."""

    def __init__(self, describer: Describer, images: TruthSequence, cache: Path) -> None:
        self.config, self.model, self.fingerprint = describer.config, describer.model, describer.fingerprint
        self.cell, self.grids = describer.cell, describer.grids
        self.at = 0
        self._describer = describer
        c = self.config
        sizes = "-".join(map(str, c.patch_sizes))
        folder = cache / f"{describer.fingerprint[:12]}_{c.trunk_precision}_{c.image_width}x{c.image_height}_{sizes}"
        folder.mkdir(parents=True, exist_ok=True)
        keys = zlib.crc32("\n".join(images.keys).encode())
        self._file = folder / f"{images.name}_{keys:08x}.npz"
        self._known: dict[int, PlaceDescriptor] = {}
        if self._file.exists():
            with np.load(self._file) as stored:
                arrays = {name: stored[name] for name in stored.files}
            for row, number in enumerate(arrays["numbers"]):
                patches = tuple(
                    PatchGrid(size, rows, cols, arrays[f"patches_{n}"][row].astype(np.float32), stride, describer.cell)
                    for n, (size, stride, rows, cols) in enumerate(describer.grids())
                )
                texture = float(arrays["texture"][row])
                self._known[int(number)] = PlaceDescriptor(arrays["vectors"][row], patches, texture)

    def describe(self, rgb: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None) -> PlaceDescriptor:
        if self.at not in self._known:
            self._known[self.at] = self._describer.describe(rgb, valid)
        return self._known[self.at]

    def save(self) -> None:
        numbers = sorted(self._known)
        known = [self._known[i] for i in numbers]
        patches = {
            f"patches_{n}": np.stack([d.patches[n].descriptors.astype(np.float16) for d in known])
            for n in range(len(self.config.patch_sizes))
        }
        vectors, texture = np.stack([d.global_vector for d in known]), np.array([d.texture for d in known])
        np.savez(self._file, numbers=numbers, vectors=vectors, texture=texture, **patches)


class RememberedVerifier:
    """The verifier of a recogniser, with what it kept of the images of a sequence read from the cache."""

    def __init__(self, verifier: Verifier, images: TruthSequence, cache: Path) -> None:
        cache.mkdir(parents=True, exist_ok=True)
        keys = zlib.crc32("\n".join(images.keys).encode())
        self._file = cache / f"{type(verifier).__name__}_{WIDTH}_{MOST}_{images.name}_{keys:08x}.npz"
        self._verifier = verifier
        self._kept: dict[int, bytes] = {}
        self.at = 0
        self.prepare, self.check, self.look_closer = verifier.prepare, verifier.check, verifier.look_closer
        if self._file.exists():
            with np.load(self._file) as stored:
                self._kept = {int(number): stored[number].tobytes() for number in stored.files}

    def keep(self, rgb: NDArray[np.uint8], camera: str, valid: NDArray[np.bool_] | None = None) -> bytes:
        if self.at not in self._kept:
            self._kept[self.at] = self._verifier.keep(rgb, camera, valid)
        return self._kept[self.at]

    def save(self) -> None:
        np.savez(self._file, **{str(i): np.frombuffer(kept, np.uint8) for i, kept in self._kept.items()})


@dataclass(frozen=True, eq=False)
class Judged:
    """What the recogniser said of a sequence: per query keyframe its candidates with their truth, best first.

    `loops` are the queries with a true keyframe among those that might be matched.
    """

    name: str
    queries: list[list[tuple[LoopClosure, int]]]
    loops: NDArray[np.bool_]
    numbers: list[tuple[int, list[int]]]  # of the query image and of its candidates'

    def candidates(self) -> Iterator[tuple[LoopClosure, int]]:
        return ((c, label) for found in self.queries for c, label in found if label in (TRUE, FALSE))


def small_motion(query: NDArray[np.uint8], match: NDArray[np.uint8]) -> bool:
    """Whether two images show one place from a little farther on, whatever the ground truth and the verifier know.

    At 320 pixels, 24 SIFT features or more agree on one epipolar geometry, or at 640 pixels 40, and the similarity
    transform between them magnifies by less than two and rolls by less than 20 degrees. The most alike images of two
    floors reach 28 at 640 pixels.
    """
    return any(_moved_a_little(query, match, *sizes) for sizes in ((320, 1000, 24), (640, 4000, 40)))


def _moved_a_little(query: NDArray[np.uint8], match: NDArray[np.uint8], width: int, most: int, least: int) -> bool:
    """By at most `most` features of images `width` pixels wide, of which at least `least` agree."""
    pair = query, match
    one, other = (sift_record(image, (width, width * image.shape[0] // image.shape[1]), most) for image in pair)
    q, m = ratio_matches(one["descriptors"], other["descriptors"])
    if len(q) < least:
        return False
    points, seen = one["points"][q], other["points"][m]
    _, mask = cv2.findFundamentalMat(points, seen, cv2.FM_RANSAC, 1.5 * width / 320, 0.99)
    inlier = np.zeros(len(q), bool) if mask is None else mask.ravel() > 0
    if inlier.sum() < least:
        return False
    transform, _ = cv2.estimateAffinePartial2D(seen[inlier], points[inlier])
    if transform is None:
        return False
    scale = math.hypot(transform[0, 0], transform[1, 0])
    roll = math.degrees(math.atan2(transform[1, 0], transform[0, 0]))
    return 0.5 < scale < 2.0 and abs(roll) < 20.0


def judged(
    images: TruthSequence,
    describer: Describer,
    cache: Path,
    pictures: Path | None = None,
    closer: bool = False,
    **settings,
) -> Judged:
    """Run the recogniser over a sequence, with the default settings but for the sequence's own exclusion window.

    Accepted pairs that count as near or as false are written side by side into the folder `pictures`. With `closer`
    every candidate in doubt is looked at closer, whatever the model's calibration makes of what that may find.
    """
    config = describer.config.replace(exclude_recent_s=images.exclude_recent_s, **settings)
    remembered = RememberedDescriber(describer, images, cache)
    remembered.config = config
    recognizer = PlaceRecognizer(remembered)  # type: ignore[arg-type]
    if closer:
        recognizer.judge.calibration = replace(recognizer.judge.calibration, matched=Logistic(0.0, {}))
    verifier = recognizer.judge.verifier = RememberedVerifier(recognizer.judge.verifier, images, cache)
    image_of: dict[int, int] = {}

    def truth(i: int, closure: LoopClosure) -> int:
        label = images.truth(i, image_of[closure.match.id])
        if label == FALSE and closure.accepted and images.name in NARROW:
            label = NEAR if small_motion(images.read(i), images.read(image_of[closure.match.id])) else FALSE
        if pictures is not None and closure.accepted and label in (NEAR, FALSE):
            pair = [images.read(number) for number in (i, image_of[closure.match.id])]
            pair = [cv2.resize(image, (320, 320 * image.shape[0] // image.shape[1])) for image in pair]
            height = min(image.shape[0] for image in pair)
            name = f"{images.name}_{'near' if label == NEAR else 'false'}_{i}_{image_of[closure.match.id]}.jpg"
            cv2.imwrite(str(pictures / name), np.hstack([image[:height] for image in pair])[:, :, ::-1])
        return label

    queries, loops, numbers = [], [], []
    for i, frame in enumerate(images.frames()):
        if i in images.starts:
            recognizer.new_session()
        remembered.at = verifier.at = i
        if images.positions is not None:
            recognizer.odometry.add(frame.stamp_ns, *images.positions[i])
        before = recognizer.database.refs()
        closures = recognizer.process(frame)
        if (last := recognizer.database.last()) is not None and last.id not in image_of:
            image_of[last.id] = i
            current = recognizer.database.session
            counted = images.queries is None or images.queries[i]
            old = [
                r
                for r in before
                if r.session != current or r.stamp_ns <= frame.stamp_ns - config.exclude_recent_s * 1e9
            ]
            if counted and old and not (images.starts and i < images.starts[0]):
                queries.append([(c, truth(i, c)) for c in closures])
                numbers.append((i, [image_of[c.match.id] for c in closures]))
                loops.append(any(images.truth(i, image_of[r.id]) == TRUE for r in old))
            elif images.queries is not None and old and not images.starts:  # no loop is known here: closures are false
                queries.append([(c, truth(i, c)) for c in closures])
                numbers.append((i, [image_of[c.match.id] for c in closures]))
                loops.append(False)
    remembered.save()
    verifier.save()
    return Judged(images.name, queries, np.array(loops, bool), numbers)


def examples(found: Judged) -> tuple[list, list[bool]]:
    pairs = list(found.candidates())
    return [c.evidence for c, _ in pairs], [label == TRUE for _, label in pairs]


def fit(shared: Path, describer: Describer, cache: Path, names: tuple[str, ...]) -> Calibration:
    """The calibration of the sets that may train a shipped model; every set counts the same, its false ones less."""
    given: list[tuple[Evidence, bool]] = []
    weights = []
    for name in names:
        found = judged(sequence(name, shared), describer, cache, closer=True, verify=6, consistency=0, accept_score=1.0)
        e, t = examples(found)
        if name == ALIKE:
            e = [replace(one, match_confidence=-1.0) for one in e]
        given += zip(e, t, strict=True)
        weights += [1.0 / len(e)] * len(e)
        print(f"{name:<16} {len(found.queries):5d} queries {len(e):6d} candidates {sum(t):5d} true", flush=True)
    told = describer.config, ", ".join(names)
    truth = np.array([true for _, true in given])
    first, closer = (
        fit_calibration(given, np.array(weights) * np.where(truth, 1.0, caution), *told)
        for caution in (CAUTION, CLOSER_CAUTION)
    )
    return replace(first, matched=closer.matched)


def recall_at_full_precision(scores: NDArray, correct: NDArray, loops: int) -> float:
    """Share of the loop queries found above the best false closure. scores, correct (Q,): each query's best."""
    highest_false = scores[~correct].max(initial=-np.inf)
    return float((correct & (scores > highest_false)).sum() / loops) if loops else float("nan")


def table(found: Judged) -> list[dict]:
    """One row per way to decide: by similarity, by spatial score, by calibrated score, and after consistency.

    `looks` are the candidates a query that were looked at closer. `first` counts the queries with a revisit whose
    first candidate is true: by that score, in the last row in the order that the recogniser gives.
    """
    rows = []
    loops = int(found.loops.sum())
    ways = {
        "global": (lambda c: c.similarity, lambda c: c.similarity >= 0.5),
        "spatial": (lambda c: c.spatial, lambda c: c.spatial >= 0.5),
        "calibrated": (lambda c: c.score, lambda c: c.score >= 0.5 and c.evidence.local_inliers >= 0),
        "confirmed": (lambda c: c.score, lambda c: c.accepted),
    }
    for way, (score, accepts) in ways.items():
        known = [[(c, label) for c, label in query if label in (TRUE, FALSE)] for query in found.queries]
        best = [max(query, key=lambda pair: score(pair[0])) if query else None for query in known]
        scores = np.array([score(b[0]) if b else -1.0 for b in best])
        correct = np.array([b is not None and b[1] == TRUE for b in best])
        leading = [query[0][1] == TRUE if query else False for query in known] if way == "confirmed" else correct
        accepted = [[label for c, label in query if accepts(c)] for query in known]
        false = sum(label != TRUE for labels in accepted for label in labels)
        true = sum(label == TRUE for labels in accepted for label in labels)
        hit = np.array([TRUE in labels for labels in accepted])
        everything = [
            (score(c), label == TRUE) for query in known for c, label in query if way != "confirmed" or c.accepted
        ]
        p = np.clip([s for s, _ in everything], 0, 1) if everything else np.zeros(0)
        t = np.array([label for _, label in everything], bool)
        rows.append(
            {
                "sequence": found.name, "way": way, "queries": len(found.queries), "loops": loops,
                "false per 1000": 1000 * false / max(len(found.queries), 1),
                "first": int((np.array(leading, bool) & found.loops).sum()),
                "near": sum(label == NEAR for query in found.queries for c, label in query if accepts(c)),
                "precision": true / (true + false) if true + false else float("nan"), "false": false,
                "recall": float((hit & found.loops).sum() / loops) if loops else float("nan"),
                "recall@100%": recall_at_full_precision(scores, correct, loops),
                "ece": reliability(p, t).expected_error if len(p) else float("nan"),
                "looks": sum(c.evidence.match_confidence >= 0 for q in found.queries for c, _ in q)
                / max(len(found.queries), 1),
            }
        )  # fmt: skip
    return rows


def printed(row: dict) -> str:
    return (
        f"{row['sequence']:<14} {row['way']:<11} {row['queries']:5d} {row['loops']:5d}  {row['precision']:9.3f} "
        f"{row['false']:6d} {row['false per 1000']:8.1f} {row['near']:5d} "
        f"{row['recall']:7.3f} {row['recall@100%']:12.3f} {row['ece']:6.3f} {row['first']:6d} "
        f"{row['looks']:6.2f}"
    )


def plot_reliability(results: list[Judged], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 5))
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="0.7")
    for found in results:
        pairs = [(c.score, label == TRUE) for c, label in found.candidates()]
        diagram = reliability(np.array([s for s, _ in pairs]), np.array([t for _, t in pairs]))
        axes.plot(diagram.score, diagram.share_true, marker="o", label=f"{found.name} ({diagram.expected_error:.3f})")
    axes.set_xlabel("score")
    axes.set_ylabel("share of true closures")
    axes.legend(title="set (expected calibration error)", fontsize="small")
    figure.savefig(path, dpi=120, bbox_inches="tight")


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="benchmarks.closures", description=__doc__)
    parser.add_argument("what", choices=("fit", "judge"))
    parser.add_argument("names", nargs="*")
    parser.add_argument("--shared", type=Path, default=Path("../shared"))
    parser.add_argument("--weights", default="default")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "pnv_closures")
    parser.add_argument("--write", action="store_true", help="write the calibration into the model file")
    parser.add_argument("--pictures", type=Path, help="folder of the accepted pairs that count as near or as false")
    parser.add_argument("--plot", type=Path, help="reliability diagram")
    args = parser.parse_intermixed_args(argv)
    describer = describer_from(Config.make(weights=args.weights))
    if args.what == "fit":
        calibration = fit(args.shared, describer, args.cache, tuple(args.names) or FIT)
        print(calibration)
        if args.write:
            write_calibration(resolve_weights(args.weights), calibration)
        return 0
    if args.pictures:
        args.pictures.mkdir(parents=True, exist_ok=True)
    print(
        f"{'sequence':<14} {'way':<11} {'query':>5} {'loops':>5}  "
        "precision  false per 1000  near  recall  recall@100%P    ece  first  looks"
    )
    results = []
    for name in args.names or JUDGE:
        found = judged(sequence(name, args.shared), describer, args.cache, args.pictures)
        results.append(found)
        for row in table(found):
            print(printed(row), flush=True)
    if args.plot:
        plot_reliability(results, args.plot)
    return 0


if __name__ == "__main__":
    sys.exit(main())

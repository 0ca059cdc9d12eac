"""Relative poses of revisits against exact poses: errors, and whether the covariances are honest.

    python -m benchmarks.relative_poses [--shared ../shared] [--sigma-depth SHARE] [NAMES]

For every revisit of known pose the verifier's matches give a pose: from the images alone (direction), with depth at the
query, with depth at the keyframe, or with the scale of odometry's way to the view before. Of ICL's truth only positions
and heading are known: there rotation is the heading's error, and metres that of the length of the way. Rendered depth
is disturbed by `--sigma-depth` of itself. Prints a Markdown table: medians, and 90th percentiles in brackets; NEES per
degree of freedom, whose mean is 1 for an honest covariance (of all but the worst 5 % here, where it would be 0.9), and
the share of errors inside the covariance's 95 % region.
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from examples.pose_graph.sequences import icl_office
from pnv_core.config import Config
from pnv_core.images import read_image
from pnv_core.pose.geometry import Intrinsics, RelativePose, depth_at, depth_by_way, relative_pose
from pnv_core.rotations import OPTICAL_IN_BODY, angle_of, inverse, logarithm
from pnv_core.verify.verifier import VERIFIERS, EpipolarCheck, Verifier
from pnv_lab.worlds import Camera, loop_sequence

Array = NDArray[np.float64]

_NEAR_M, _NEAR_DEG = 1.5, 30.0
_WAYS = "direction", "depth of the query", "depth of the keyframe", "depth of both", "odometry's way"


@dataclass(frozen=True, eq=False)
class Posed:
    """Images with exact camera poses (n, 4, 4), optical. `depth` is None where the set has none."""

    name: str
    camera: Intrinsics
    poses: Array
    image: Callable[[int], NDArray[np.uint8]]
    depth: Callable[[int], NDArray[np.float32]] | None
    gap: int  # frames; a revisit is at least so much older
    every: int  # frames between queries
    level: bool = False  # of the rotation only the heading is known


def rendered(kind: str, seed: int) -> Posed:
    """Two laps, the second in another light and on another line."""
    size = (640, 480)
    sequence = loop_sequence(seed, kind, laps=1.5, speed_m_s=1.0, fps=2.0, size=size)
    k = Camera(*size).matrix()
    camera = Intrinsics.of_pixels(k[0, 0], k[1, 1], k[0, 2], k[1, 2], size[0])

    def depth(i: int) -> NDArray[np.float32]:
        return sequence.world.depth(sequence.poses[i], size)

    return Posed(f"{kind} {seed}", camera, sequence.matrices @ OPTICAL_IN_BODY, lambda i: sequence[i].rgb, depth, 40, 2)


def icl(folder: Path) -> Posed:
    walk = icl_office(folder)
    images = sorted((folder / "images").iterdir())
    assert walk.intrinsics is not None
    camera = Intrinsics.of_pixels(*walk.intrinsics, 640)
    poses = walk.truth @ OPTICAL_IN_BODY
    return Posed("icl_office_kt3", camera, poses, lambda i: read_image(images[i]), None, 150, 2, level=True)


def revisits(posed: Posed) -> Iterator[tuple[int, int]]:
    """(query, match): the nearest older view within 1.5 m and 30 degrees."""
    p = posed.poses
    for query in range(posed.gap, len(p), posed.every):
        way = np.linalg.norm(p[: query - posed.gap, :3, 3] - p[query, :3, 3], axis=1)
        turned = np.degrees(angle_of(p[query, :3, :3].T @ p[: query - posed.gap, :3, :3]))
        way[turned > _NEAR_DEG] = np.inf
        if way.min(initial=np.inf) <= _NEAR_M:
            yield query, int(way.argmin())


@dataclass(frozen=True)
class Error:
    """Of one pose: degrees, degrees of direction, metres, NEES over its degrees of freedom, and those."""

    turn: float
    direction: float
    metres: float
    nees: float
    freedom: int


def error_of(found: RelativePose, truth: Array, level: bool) -> Error:
    """Of a `level` truth the heading and the length of the way are compared."""
    turn, t = logarithm(truth[:3, :3] @ found.rotation.T), truth[:3, 3]
    if level:
        metres = abs(float(np.linalg.norm(found.translation) - np.linalg.norm(t))) if found.metric else np.nan
        return Error(float(np.degrees(abs(turn[1]))), np.nan, metres, np.nan, 1)
    length, direction = float(np.linalg.norm(t)), np.nan
    if found.translation.any() and length > 0:
        cosine = found.translation @ t / length / np.linalg.norm(found.translation)
        direction = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    if found.metric:
        off, freedom = t - found.translation, 6
    else:
        known = found.translation.any()
        off, freedom = (t / length - found.translation, 5) if known else (np.zeros(3), 3)
    away = np.append(off, turn)
    nees = float(away @ np.linalg.pinv(found.covariance, rcond=1e-7, hermitian=True) @ away)
    metres = float(np.linalg.norm(off)) if found.metric else np.nan
    return Error(float(np.degrees(np.linalg.norm(turn))), direction, metres, nees / freedom, freedom)


def measured(posed: Posed, verifier: Verifier, sigma_depth: float) -> dict[str, list[Error | None]]:
    """The errors by way of estimation; None for a revisit it says nothing of."""
    rng, errors = np.random.default_rng(0), {way: [] for way in _WAYS}
    kept: dict[int, bytes] = {}

    def check(a: int, b: int) -> EpipolarCheck:
        for i in (a, b):
            if i not in kept:
                kept[i] = verifier.keep(posed.image(i), posed.name)
        return verifier.check(kept[a], posed.name, kept[b], posed.name)

    def depth(i: int, points: NDArray) -> Array | None:
        if posed.depth is None:
            return None
        return depth_at(posed.depth(i), points) * (1 + rng.normal(0, sigma_depth, len(points)))

    for query, match in revisits(posed):
        truth, pair = inverse(posed.poses[match]) @ posed.poses[query], check(query, match)
        here, there = depth(query, pair.query), depth(match, pair.reference)
        before = query - 1
        while before > 0 and np.linalg.norm((posed.poses[query] - posed.poses[before])[:3, 3]) < 0.2:
            before -= 1
        step = inverse(posed.poses[before]) @ posed.poses[query]
        beside = check(query, before)
        way = float(np.linalg.norm(step[:3, 3]))
        by_odometry = at_points(pair, beside, depth_by_way(beside, posed.camera, posed.camera, way))
        given = {
            "direction": (None, None), "depth of the query": (here, None), "depth of the keyframe": (None, there),
            "depth of both": (here, there), "odometry's way": (by_odometry, None),
        }  # fmt: skip
        for way, (a, b) in given.items():
            if way == "direction" or a is not None or b is not None:
                error = 0.1 if way == "odometry's way" else 0.0  # as RelativePoses has it
                found = relative_pose(pair, posed.camera, posed.camera, a, b, error)
                useful = found is not None and (found.metric or way == "direction")
                errors[way].append(error_of(found, truth, posed.level) if useful else None)
    return errors


def at_points(pair: EpipolarCheck, beside: EpipolarCheck, depth: Array) -> Array:
    """Depths of a check's query points at the same points of another check of the same query."""
    known = {tuple(p): z for p, z in zip(beside.query, depth, strict=True)}
    return np.array([known.get(tuple(p), np.nan) for p in pair.query])


def row(name: str, way: str, errors: list[Error | None]) -> str:
    found = [e for e in errors if e is not None]
    if not found:
        return f"| {name} | {way} | {len(errors)} | 0 % |" + " |" * 5

    def cell(field: str, digits: int) -> str:
        values = np.array([getattr(e, field) for e in found])
        values = values[np.isfinite(values)]
        if not len(values):
            return ""
        return f"{np.median(values):.{digits}f} ({np.quantile(values, 0.9):.{digits}f})"

    nees = np.sort([e.nees for e in found])
    inside = np.mean([e.nees * e.freedom < chi2.ppf(0.95, e.freedom) for e in found])
    kept = nees[: max(1, int(0.95 * len(nees)))]
    judged = (f"{kept.mean():.2f}", f"{inside:.0%}") if np.isfinite(nees[0]) else ("", "")
    cells = [name, way, str(len(errors)), f"{len(found) / len(errors):.0%}", cell("turn", 2), cell("direction", 1),
             cell("metres", 3), *judged]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="sets to measure, by the start of their names; default all")
    parser.add_argument("--shared", type=Path, default=Path("../shared"))
    parser.add_argument("--sigma-depth", type=float, default=0.005, help="noise of rendered depth, as a share of it")
    parser.add_argument("--verifier", default=Config.make().verifier)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    sets: dict[str, Callable[[], Posed]] = {
        kind: lambda kind=kind, seed=seed: rendered(kind, seed)
        for kind, seed in (("corridor", 1), ("hall", 2), ("street", 2))
    }
    folder = args.shared / "data" / "icl_office_kt3_synth"
    if (folder / "poses.csv").is_file():
        sets["icl"] = lambda: icl(folder)
    head = "set", "scale from", "revisits", "answered", "rotation, deg", "direction, deg", "metres", "NEES", "in 95 %"
    print("| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|")
    for name, build in sets.items():
        if not args.names or any(name.startswith(one) for one in args.names):
            posed = build()
            for way, errors in measured(posed, VERIFIERS.make(args.verifier), args.sigma_depth).items():
                if errors:
                    print(row(posed.name, way, errors), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())

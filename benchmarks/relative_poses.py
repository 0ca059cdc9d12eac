"""Relative poses of revisits against exact poses: errors, and whether the covariances are honest.

    python -m benchmarks.relative_poses [--shared ../shared] [--sigma-depth SHARE] [NAMES]

For every revisit of known pose the verifier's matches give a pose: from the images alone (direction), with depth at the
query, with depth at the keyframe, or with the scale of odometry's way to the view before. Of ICL's truth only positions
and heading are known: there rotation is the heading's error, and metres that of the length of the way. Rendered depth
is disturbed by `--sigma-depth` of itself. Prints a Markdown table: the share that is answered, and of those the share
with a direction where that is all there is; medians, and 90th percentiles in brackets; NEES per degree of freedom: its
mean without the worst 5 %, and its 50th, 90th and 95th percentile. Of an honest covariance these are 0.9, and 0.9, 1.8
and 2.1 to 2.2 for 6 and 5 degrees of freedom; below it is cautious.
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
from pnv_core.pose.geometry import Intrinsics, RelativePose, depth_at, pose_by_way, relative_pose
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
    known = bool(found.translation.any())
    if known and length > 0:
        cosine = found.translation @ t / length / np.linalg.norm(found.translation)
        direction = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    if found.metric:
        off, freedom, basis = t - found.translation, 6, np.eye(6)
    elif known:  # how far along the sphere of directions, in its tangent plane
        across = np.linalg.svd(found.translation[None])[2][1:]
        side = across @ t
        off = np.radians(direction) * across.T @ side / max(float(np.linalg.norm(side)), 1e-12)
        freedom, basis = 5, np.zeros((5, 6))
        basis[:2, :3], basis[2:, 3:] = across, np.eye(3)
    else:
        off, freedom, basis = np.zeros(3), 3, np.eye(6)[3:]
    away = basis @ np.append(off, turn)
    nees = float(away @ np.linalg.solve(basis @ found.covariance @ basis.T, away))
    metres = float(np.linalg.norm(off)) if found.metric else np.nan
    return Error(float(np.degrees(np.linalg.norm(turn))), direction, metres, nees / freedom, freedom)


def measured(posed: Posed, verifier: Verifier, sigma_depth: float) -> tuple[dict[str, list[Error | None]], Array]:
    """The errors by way of estimation, None for a revisit it says nothing of; how far distinct matches are off (n,), in
    640ths of the width, where depth is known.
    """
    rng = np.random.default_rng(0)
    errors: dict[str, list[Error | None]] = {way: [] for way in _WAYS}
    apart: list[Array] = []
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
        if posed.depth is not None:
            assert pair.distinct is not None
            exact = depth_at(posed.depth(query), pair.query)
            rays, to = (posed.camera.rays(side) for side in (pair.query, pair.reference))
            at = np.column_stack([rays, np.ones(len(rays))]) * exact[:, None] @ truth[:3, :3].T + truth[:3, 3]
            gap = np.linalg.norm((at[:, :2] / at[:, 2:] - to) * (posed.camera.fx, posed.camera.fy), axis=1) * 640
            apart.append(gap[pair.distinct & np.isfinite(gap)])
        before = query - 1
        while before > 0 and np.linalg.norm((posed.poses[query] - posed.poses[before])[:3, 3]) < 0.2:
            before -= 1
        step = inverse(posed.poses[before]) @ posed.poses[query]
        beside = check(query, before)
        metres = float(np.linalg.norm(step[:3, 3]))
        k = posed.camera
        given = {
            "direction": (None, None), "depth of the query": (here, None), "depth of the keyframe": (None, there),
            "depth of both": (here, there),
        }  # fmt: skip
        found = {
            name: relative_pose(pair, k, k, a, b)
            for name, (a, b) in given.items()
            if name == "direction" or posed.depth
        }
        found["odometry's way"] = pose_by_way(pair, beside, k, k, k, metres, 0.1)  # as RelativePoses has it
        for name, pose in found.items():
            if pose is not None and not (pose.metric or name == "direction"):
                pose = None
            errors[name].append(None if pose is None else error_of(pose, truth, posed.level))
    return errors, np.concatenate(apart) if apart else np.empty(0)


def row(name: str, way: str, errors: list[Error | None]) -> str:
    found = [e for e in errors if e is not None]
    if not found:
        return f"| {name} | {way} | {len(errors)} | 0 % |" + " |" * 6

    def cell(field: str, digits: int) -> str:
        values = np.array([getattr(e, field) for e in found])
        values = values[np.isfinite(values)]
        if not len(values):
            return ""
        return f"{np.median(values):.{digits}f} ({np.quantile(values, 0.9):.{digits}f})"

    nees = np.sort([e.nees for e in found])
    inside = np.mean([e.nees * e.freedom < chi2.ppf(0.95, e.freedom) for e in found])
    quantiles = " / ".join(f"{value:.2f}" for value in np.quantile(nees, (0.5, 0.9, 0.95)))
    kept = nees[: max(1, int(0.95 * len(nees)))]
    judged = (f"{kept.mean():.2f}", quantiles, f"{inside:.0%}") if np.isfinite(nees[0]) else ("", "", "")
    answered = f"{len(found) / len(errors):.0%}"
    if way == "direction" and np.isfinite(nees[0]):
        answered += f", {sum(e.freedom == 5 for e in found) / len(found):.0%} of them directed"
    cells = [name, way, str(len(errors)), answered, cell("turn", 2), cell("direction", 1),
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
    head = (
        "set",
        "scale from",
        "revisits",
        "answered",
        "rotation, deg",
        "direction, deg",
        "metres",
        "NEES",
        "its 50 / 90 / 95 %",
        "in 95 %",
    )
    print("| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|")
    for name, build in sets.items():
        if not args.names or any(name.startswith(one) for one in args.names):
            posed = build()
            by_way, apart = measured(posed, VERIFIERS.make(args.verifier), args.sigma_depth)
            for way, errors in by_way.items():
                if errors:
                    print(row(posed.name, way, errors), flush=True)
            if len(apart):
                shares = ", ".join(f"{np.mean(apart < most):.0%} within {most}" for most in (1, 2, 4, 8))
                print(f"{posed.name}: of the distinct matches {shares} pixels of 640", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())

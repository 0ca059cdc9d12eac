"""The walks of the SLAM demo: how each is published, its true poses, and how its recogniser and graph are set."""

import csv
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from examples.pose_graph.drift import Drift
from pnv_core.pose.graph import Noise
from pnv_lab.worlds import Camera, Pose, loop_sequence

Array = NDArray[np.float64]


_ICL_CAMERA = (481.2, 480.0, 319.5, 239.5)  # of the ICL-NUIM data set's page, 640x480


@dataclass(frozen=True, eq=False)
class Walk:
    """A sequence with known poses. `flags` name it to the publisher; `parameters` are the node's."""

    name: str
    flags: list[str]
    stamps_ns: list[int]
    truth: Array  # (n, 4, 4), x ahead, y left, z up
    playback: float
    drift: Drift
    noise: Noise
    parameters: dict[str, Any] = field(default_factory=dict)
    intrinsics: tuple[float, float, float, float] | None = None  # fx, fy, cx, cy in pixels, where they are known
    depth: Callable[[int], NDArray[np.float32]] | None = None  # (h, w) metres of a frame, by its number


def world(kind: str, seed: int, laps: float, speed: float, tolerance_m: float) -> Walk:
    """A rendered place, walked on after the loop has closed."""
    sequence = loop_sequence(seed, kind, laps=laps, speed_m_s=speed, fps=2.0)
    flags = ["--world", kind, "--seed", str(seed), "--laps", str(laps), "--speed", str(speed)]
    noise = Noise(tolerance_m=tolerance_m)
    k = Camera(*sequence.size).matrix()
    intrinsics = (k[0, 0], k[1, 1], k[0, 2], k[1, 2])

    def depth(number: int) -> NDArray[np.float32]:
        return sequence.world.depth(sequence.poses[number], sequence.size)

    stamps = list(sequence.stamps_ns)
    return Walk(f"{kind} {seed}", flags, stamps, sequence.matrices, 2.0, Drift(), noise, {}, intrinsics, depth)


def icl_office(folder: Path) -> Walk:
    """ICL-NUIM office kt3, carried by hand: 7.7 m of way, one turn around. The end returns to the start.

    Its poses have x right, y up, z ahead and the heading to the right; the way is short for its turns, so the
    drift is that of the turns.
    """

    def pose(x: float, y: float, z: float, yaw: float) -> Pose:
        return Pose(z, -x, y, -yaw)

    stamps, truth = _poses(folder / "poses.csv", pose)
    drift = Drift(deg_per_m=0.0, turn=0.08)
    parameters = {"exclude_recent_s": 15.0, "min_interval_s": 0.3}
    noise = Noise(odometry_deg_per_deg=0.08, tolerance_m=0.15, tolerance_deg=10.0)
    return Walk("icl_office_kt3", _flags(folder), stamps, truth, 0.7, drift, noise, parameters, _ICL_CAMERA)


def ikuta_campus(folder: Path) -> Walk:
    """A campus, 217 m around. Keyframes are 3 m apart; only the last two see the first two again, 6 to 9 m away."""
    stamps, truth = _poses(folder / "poses.csv", lambda x, y, z, yaw: Pose(x, y, z, yaw))
    noise = Noise(tolerance_m=5.0)
    parameters = {"consistency": 1}
    return Walk("ikuta_campus", _flags(folder), stamps, truth, 2.5, Drift(), noise, parameters)


def _flags(folder: Path) -> list[str]:
    return ["--images", str(folder / "images"), "--timestamps", str(folder / "poses.csv")]


def _poses(path: Path, pose: Callable[..., Pose]) -> tuple[list[int], Array]:
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    stamps = [round(float(row["timestamp"]) * 1e9) for row in rows]
    truth = [pose(*(float(row[key]) for key in ("x", "y", "z", "yaw"))).matrix() for row in rows]
    return stamps, np.array(truth)


def walks(shared: Path) -> list[Walk]:
    """Three rendered places, and the recorded walks whose data is there."""
    rendered = [
        world("corridor", 1, 1.4, 1.0, 0.5),
        world("hall", 2, 1.4, 1.0, 0.5),
        world("street", 2, 1.25, 2.0, 1.0),
    ]
    recorded = [
        build(shared / name)
        for name, build in (("icl_office_kt3_synth", icl_office), ("ikuta_campus_loop", ikuta_campus))
        if (shared / name / "poses.csv").is_file()
    ]
    return rendered + recorded

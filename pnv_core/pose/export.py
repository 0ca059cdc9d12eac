"""Closures and poses for offline tools: CSV, g2o pose graphs, TUM trajectories, image pairs."""

import csv
import io
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pnv_core.errors import PnvError
from pnv_core.pose.geometry import RelativePose
from pnv_core.rotations import local_covariance, matrix_of, quaternion_of
from pnv_core.types import LoopClosure

Array = NDArray[np.float64]

CSV_COLUMNS = (
    "query_stamp_ns", "match_stamp_ns", "query_id", "match_id", "query_camera", "match_camera", "score", "similarity",
    "spatial", "inliers", "spread", "local_inliers", "local_spread", "accepted", "reason",
)  # fmt: skip


def closures_to_csv(closures: Sequence[LoopClosure]) -> str:
    """One row per closure, refused ones too; stamps as whole nanoseconds."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    for c in closures:
        e = c.evidence
        seen = ("", "", "") if e is None else (f"{e.spread:.4f}", e.local_inliers, f"{e.local_spread:.4f}")
        writer.writerow(
            (c.query.stamp_ns, c.match.stamp_ns, c.query.id, c.match.id, c.query.camera, c.match.camera,
             f"{c.score:.6f}", f"{c.similarity:.6f}", f"{c.spatial:.6f}", c.inliers, *seen, int(c.accepted), c.reason)
        )  # fmt: skip
    return text.getvalue()


@dataclass(frozen=True, eq=False)
class GraphPose:
    """A node of a pose graph: position (3,) in metres and quaternion (4,) as x, y, z, w."""

    position: Array
    quaternion: Array


def poses_to_tum(poses: Mapping[int, GraphPose]) -> str:
    """A trajectory by stamp in nanoseconds: `timestamp tx ty tz qx qy qz qw` a line, seconds and metres."""
    lines = [
        f"{stamp // 10**9}.{stamp % 10**9:09d} {_numbers(p.position)} {_numbers(p.quaternion)}"
        for stamp, p in sorted(poses.items())
    ]
    return "".join(line + "\n" for line in lines)


def pairs_to_hloc(pairs: Iterable[tuple[str, str]]) -> str:
    """Image names, `query reference` a line, as hloc and COLMAP's matches importer read them.

    Raises PnvError for a name with white space, which the format has no way to write.
    """
    lines = []
    for pair in pairs:
        for name in pair:
            if not name or len(name.split()) != 1:
                raise PnvError(f"image name {name!r}; allowed in a pairs file: names without white space")
        lines.append(" ".join(pair) + "\n")
    return "".join(lines)


def graph_to_g2o(
    nodes: Mapping[int, GraphPose],
    closures: Sequence[tuple[LoopClosure, RelativePose | None]],
    odometry_sigma: tuple[float, float] = (0.05, 0.01),
) -> str:
    """A 3D pose graph: nodes by keyframe id, edges between successive nodes, and an edge per metric closure.

    The nodes' poses are the camera's (optical frame), as odometry saw them. `odometry_sigma` is metres and radians per
    edge. A closure without scale becomes a comment: an edge would have to make one up. Closures of keyframes that are
    no nodes are left out.
    """
    lines = [f"VERTEX_SE3:QUAT {i} {_numbers(n.position)} {_numbers(n.quaternion)}" for i, n in sorted(nodes.items())]
    order = sorted(nodes)
    information = np.diag([odometry_sigma[0] ** -2] * 3 + [odometry_sigma[1] ** -2] * 3)
    for a, b in itertools.pairwise(order):
        rotation = matrix_of(nodes[a].quaternion)
        position = rotation.T @ (np.asarray(nodes[b].position) - nodes[a].position)
        lines.append(_edge(a, b, position, quaternion_of(rotation.T @ matrix_of(nodes[b].quaternion)), information))
    for closure, pose in closures:
        a, b = closure.match.id, closure.query.id
        if a not in nodes or b not in nodes:
            continue
        if pose is None or not pose.metric:
            lines.append(f"# closure {a} {b} score {closure.score:.6f} without scale")
        else:
            information = np.linalg.inv(local_covariance(pose.covariance, pose.matrix)).astype(np.float64)
            lines.append(_edge(a, b, pose.translation, pose.quaternion, information))
    return "\n".join(lines) + "\n"


def pose_graph_to_g2o(poses: Array, edges: Sequence[tuple[int, int, Array, Array]]) -> str:
    """Poses (n, 4, 4) by number, and edges (from, to, relative (4, 4), information (6, 6) with position first)."""
    lines = [
        f"VERTEX_SE3:QUAT {i} {_numbers(p[:3, 3])} {_numbers(quaternion_of(p[:3, :3]))}" for i, p in enumerate(poses)
    ]
    lines += [_edge(a, b, step[:3, 3], quaternion_of(step[:3, :3]), information) for a, b, step, information in edges]
    return "".join(line + "\n" for line in lines)


def _edge(a: int, b: int, position: Array, quaternion: Array, information: Array) -> str:
    # g2o's rotation error is the vector part of the quaternion, half the angle: its information is four times as large
    scale = np.array([1, 1, 1, 2, 2, 2])
    upper = (information * np.outer(scale, scale))[np.triu_indices(6)]
    return f"EDGE_SE3:QUAT {a} {b} {_numbers(position)} {_numbers(quaternion)} {_numbers(upper)}"


def _numbers(values: Sequence[float] | Array) -> str:
    return " ".join(f"{float(v) + 0.0:.9g}" for v in values)  # + 0.0: no negative zeros

"""Closures and poses for offline tools: CSV, g2o and RTAB-Map pose graphs, TUM trajectories, image pairs."""

import csv
import io
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pnv_core.errors import PnvError
from pnv_core.pose.geometry import RelativePose
from pnv_core.rotations import local_covariance, matrix_of, quaternion_of
from pnv_core.types import ImageRef, LoopClosure

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
    lines += [_edge(*edge) for edge in _odometry_edges(nodes, odometry_sigma)]
    for closure, pose in closures:
        a, b = closure.match.id, closure.query.id
        if a in nodes and b in nodes:
            edge = _closure_edge(closure, pose)
            lines.append(_edge(*edge) if edge else f"# closure {a} {b} score {closure.score:.6f} without scale")
    return "\n".join(lines) + "\n"


def graph_to_toro(
    nodes: Mapping[int, GraphPose],
    closures: Sequence[tuple[LoopClosure, RelativePose | None]],
    odometry_sigma: tuple[float, float] = (0.05, 0.01),
) -> str:
    """The same graph in TORO's format, which RTAB-Map reads (corelib/src/optimizer/OptimizerTORO.cpp, loadGraph).

    Its reader takes lines of VERTEX3 (8 words) and EDGE3 (30 words) only, optimises ids above 0, so they are counted on
    by one, and reads the information of roll, pitch, yaw before that of x, y, z. It has no comments: a closure without
    scale is left out.
    """
    lines = [f"VERTEX3 {i + 1} {_euler_pose(n.position, n.quaternion)}" for i, n in sorted(nodes.items())]
    measured = [_closure_edge(c, pose) for c, pose in closures if c.match.id in nodes and c.query.id in nodes]
    for a, b, position, quaternion, information in (*_odometry_edges(nodes, odometry_sigma), *filter(None, measured)):
        order = [3, 4, 5, 0, 1, 2]
        upper = information[np.ix_(order, order)][np.triu_indices(6)]
        lines.append(f"EDGE3 {a + 1} {b + 1} {_euler_pose(position, quaternion)} {_short(upper)}")
    return "".join(line + "\n" for line in lines)


def exported(
    kind: str,
    nodes: Mapping[ImageRef, GraphPose],
    closures: Sequence[tuple[LoopClosure, RelativePose | None]],
    name: Callable[[ImageRef], str],
) -> str:
    """The text of a file of one of `KINDS`, the same for every command; `name` is what an image is called.

    Raises PnvError for names that a pairs file cannot hold.
    """
    by_id = {ref.id: pose for ref, pose in nodes.items()}
    return {
        "closures": lambda: closures_to_csv([c for c, _ in closures]),
        "pairs": lambda: pairs_to_hloc([(name(c.query), name(c.match)) for c, _ in closures]),
        "tum": lambda: poses_to_tum({ref.stamp_ns: pose for ref, pose in nodes.items()}),
        "g2o": lambda: graph_to_g2o(by_id, closures),
        "rtabmap": lambda: graph_to_toro(by_id, closures),
    }[kind]()


KINDS = ("closures", "pairs", "tum", "g2o", "rtabmap")
OF_POSES = ("tum", "g2o", "rtabmap")  # those that are nothing without poses

_Edge = tuple[int, int, Array, Array, Array]  # from, to, position, quaternion, information with position first


def _odometry_edges(nodes: Mapping[int, GraphPose], sigma: tuple[float, float]) -> list[_Edge]:
    information = np.diag([sigma[0] ** -2] * 3 + [sigma[1] ** -2] * 3)
    edges = []
    for a, b in itertools.pairwise(sorted(nodes)):
        rotation = matrix_of(nodes[a].quaternion)
        position = rotation.T @ (np.asarray(nodes[b].position) - nodes[a].position)
        edges.append((a, b, position, quaternion_of(rotation.T @ matrix_of(nodes[b].quaternion)), information))
    return edges


def _closure_edge(closure: LoopClosure, pose: RelativePose | None) -> _Edge | None:
    """None without scale."""
    if pose is None or not pose.metric:
        return None
    information = np.linalg.inv(local_covariance(pose.covariance, pose.matrix)).astype(np.float64)
    return closure.match.id, closure.query.id, pose.translation, pose.quaternion, information


def _euler_pose(position: Array, quaternion: Array) -> str:
    """x y z roll pitch yaw, rotations about the fixed axes x, y, z."""
    r = matrix_of(quaternion)
    pitch = math.atan2(-r[2, 0], math.hypot(r[0, 0], r[1, 0]))
    return _short([*position, math.atan2(r[2, 1], r[2, 2]), pitch, math.atan2(r[1, 0], r[0, 0])])


def _short(values: Sequence[float] | Array) -> str:
    """Fewer digits: RTAB-Map reads lines of at most 400 characters."""
    return " ".join(f"{float(v) + 0.0:.6g}" for v in values)


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

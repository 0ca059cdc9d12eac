"""LoopClosure lists to and from messages. N closures, C columns.

The layout of `/loop_closures` is a contract with other programs: columns are only ever appended.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from pnv_core.errors import PnvError
from pnv_core.types import ImageRef, LoopClosure, Reason

COLUMNS = (
    "query_stamp",
    "match_stamp",
    "score",
    "query_id",
    "match_id",
    "query_nsec",
    "match_nsec",
    "similarity",
    "spatial",
    "inliers",
    "query_camera",
    "match_camera",
)
ROBOTS = ("query_robot", "match_robot")  # appended where a closure is with another robot's, or another day's, places

NO_CAMERA = -1  # a match in a saved map whose camera is not among the topics of this run

CANDIDATE_FIELDS = {
    "query_sec": "<i4",
    "query_nsec": "<u4",
    "match_sec": "<i4",
    "match_nsec": "<u4",
    "query_id": "<f8",  # PointField has no 64 bit integer; exact up to 2**53
    "match_id": "<f8",
    "query_camera": "<i4",
    "match_camera": "<i4",
    "score": "<f4",
    "similarity": "<f4",
    "spatial": "<f4",
    "inliers": "<i4",
    "accepted": "<u1",
    "reason": "<u1",
}
_TABLE = np.dtype([*CANDIDATE_FIELDS.items(), ("padding", "V6")])  # rows stay aligned to 8 bytes
_NAMED = np.dtype([*CANDIDATE_FIELDS.items(), ("padding", "V2"), *((name, "<i4") for name in ROBOTS), ("more", "V4")])
_REASON_CODES = {reason: code for code, reason in enumerate(Reason)}
_POINT_TYPES = {
    "i4": PointField.INT32,
    "u4": PointField.UINT32,
    "f4": PointField.FLOAT32,
    "f8": PointField.FLOAT64,
    "u1": PointField.UINT8,
}


def epoch_seconds(stamp_ns: int) -> float:
    """Seconds whose floor is the stamp's whole second, which plain rounding does not keep near the next one."""
    second = stamp_ns // 1_000_000_000
    return min(stamp_ns / 1e9, math.nextafter(second + 1.0, second))


def robots_of(closures: Sequence[LoopClosure]) -> list[str]:
    """The robots that closures name, in order; none where all are of one robot's own map."""
    return list(dict.fromkeys(r.robot for c in closures for r in (c.query, c.match) if r.robot))


def to_time(stamp_ns: int) -> Time:
    """Nanoseconds as builtin_interfaces/Time."""
    return Time(sec=stamp_ns // 1_000_000_000, nanosec=stamp_ns % 1_000_000_000)


def closures_to_message(closures: Sequence[LoopClosure], cameras: Sequence[str]) -> Float64MultiArray:
    """N closures -> Float64MultiArray of N x C doubles in the given order; cameras become their index in `cameras`.

    Where robots are named there are two columns more, indices into the names behind the columns in the label:
    "...,match_camera,query_robot,match_robot|alpha|beta".
    """
    rows = [
        (
            epoch_seconds(c.query.stamp_ns),
            epoch_seconds(c.match.stamp_ns),
            c.score,
            c.query.id,
            c.match.id,
            c.query.stamp_ns % 1_000_000_000,
            c.match.stamp_ns % 1_000_000_000,
            c.similarity,
            c.spatial,
            c.inliers,
            _camera_index(c.query.camera, cameras),
            _camera_index(c.match.camera, cameras),
        )
        for c in closures
    ]
    message = Float64MultiArray()
    robots: list[tuple[int, ...]] = [()] * len(rows)
    names, label, count, width = robots_of(closures), ",".join(COLUMNS), len(rows), len(COLUMNS)
    if names:
        label = "|".join([",".join(COLUMNS + ROBOTS), *names])
        robots = [(names.index(c.query.robot), names.index(c.match.robot)) for c in closures]
        width += len(ROBOTS)
    message.layout.dim = [
        MultiArrayDimension(label="closures", size=count, stride=count * width),
        MultiArrayDimension(label=label, size=width, stride=width),
    ]
    message.data = [float(value) for row, pair in zip(rows, robots, strict=True) for value in (*row, *pair)]
    return message


def closures_from_message(message: Any, cameras: Sequence[str] = ()) -> list[LoopClosure]:
    """The closures of a `/loop_closures` message, in order. Columns are found by name, unknown ones are ignored.

    A camera index beyond `cameras` becomes its number as text. Raises PnvError for a layout that is not the contract.
    """
    dims = message.layout.dim
    if len(dims) != 2 or dims[0].label != "closures":
        raise PnvError(f"message has dimensions {[d.label for d in dims]}; allowed: closures, {','.join(COLUMNS)}")
    label, *robots = dims[1].label.split("|")
    names = label.split(",")
    missing = [name for name in COLUMNS if name not in names]
    if missing or len(names) != dims[1].size:
        raise PnvError(f"message has columns {dims[1].label!r}; allowed: at least {','.join(COLUMNS)}")
    if len(message.data) != dims[0].size * dims[1].size:
        raise PnvError(f"message has {len(message.data)} values; allowed: {dims[0].size} x {dims[1].size}")
    table = np.asarray(message.data, np.float64).reshape(dims[0].size, dims[1].size)
    column = {name: table[:, names.index(name)] for name in COLUMNS + ROBOTS if name in names}
    return [
        LoopClosure(
            query=_ref("query", row, column, cameras, robots),
            match=_ref("match", row, column, cameras, robots),
            score=float(column["score"][row]),
            similarity=float(column["similarity"][row]),
            spatial=float(column["spatial"][row]),
            inliers=int(column["inliers"][row]),
            accepted=True,
        )
        for row in range(len(table))
    ]


def closure_to_lio_sam(closure: LoopClosure) -> Float64MultiArray:
    """LIO-SAM's external loop input: exactly two doubles, query (newer) and match (older) in epoch seconds.

    LIO-SAM keys loops by these stamps and drops a message of any other length.
    """
    return Float64MultiArray(data=[epoch_seconds(closure.query.stamp_ns), epoch_seconds(closure.match.stamp_ns)])


def candidates_to_message(closures: Sequence[LoopClosure], cameras: Sequence[str], frame_id: str = "") -> PointCloud2:
    """Every candidate examined as a typed table, one point per candidate; `reason` is the number in Reason's order.

    The header carries the query's stamp. Where robots are named, two fields more are indices into the names behind the
    last field's: "match_robot|alpha|beta".
    """
    names = robots_of(closures)
    table = np.zeros(len(closures), _NAMED if names else _TABLE)
    for row, c in zip(table, closures, strict=True):
        for side, ref in (("query", c.query), ("match", c.match)):
            row[f"{side}_sec"], row[f"{side}_nsec"] = divmod(ref.stamp_ns, 1_000_000_000)
            row[f"{side}_id"] = ref.id
            row[f"{side}_camera"] = _camera_index(ref.camera, cameras)
            if names:
                row[f"{side}_robot"] = names.index(ref.robot)
        for name in ("score", "similarity", "spatial", "inliers", "accepted"):
            row[name] = getattr(c, name)
        row["reason"] = _REASON_CODES[c.reason]
    message = PointCloud2(height=1, width=len(table), point_step=table.itemsize, row_step=table.nbytes, is_dense=True)
    message.header.frame_id = frame_id
    if closures:
        message.header.stamp = to_time(closures[0].query.stamp_ns)
    for name in [*CANDIDATE_FIELDS, *(ROBOTS if names else ())]:
        kind, offset = table.dtype.fields[name][:2]  # type: ignore[index]
        full = "|".join([name, *names]) if name == ROBOTS[-1] else name
        message.fields.append(PointField(name=full, offset=offset, datatype=_POINT_TYPES[kind.str[1:]], count=1))
    message.data = table.tobytes()
    return message


def candidates_table(message: Any) -> np.ndarray:
    """The rows of a candidates message as a structured array, by the message's own fields."""
    kinds = {code: kind for kind, code in _POINT_TYPES.items()}
    row = np.dtype(
        {
            "names": [field.name for field in message.fields],
            "formats": [f"<{kinds[field.datatype]}" for field in message.fields],
            "offsets": [field.offset for field in message.fields],
            "itemsize": message.point_step,
        }
    )
    return np.frombuffer(bytes(message.data), row)


def _camera_index(camera: str, cameras: Sequence[str]) -> int:
    return cameras.index(camera) if camera in cameras else NO_CAMERA


def _ref(side: str, row: int, column: dict[str, Any], cameras: Sequence[str], robots: Sequence[str]) -> ImageRef:
    camera = int(column[f"{side}_camera"][row])
    robot = int(column[f"{side}_robot"][row]) if f"{side}_robot" in column else -1
    return ImageRef(
        id=int(column[f"{side}_id"][row]),
        stamp_ns=math.floor(column[f"{side}_stamp"][row]) * 1_000_000_000 + int(column[f"{side}_nsec"][row]),
        camera=cameras[camera] if 0 <= camera < len(cameras) else str(camera),
        robot=robots[robot] if 0 <= robot < len(robots) else "",
    )

"""Places: a keyframe as it is shared, as bytes and as a row. D = dimension of the global vector.

    view = "PNVV", crc32 u32 of the rest, length u16, JSON of that length (precision and grids), the patches as
    pnv_core.database.patch_codes lays them out, then the local features (or, where asked for, the picture)

Nothing that comes back is believed before it is bounded: every size is checked against what this file allows and
against the bytes that are there, every number for being one.
"""

import base64
import binascii
import hashlib
import json
import math
import re
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnv_core.database.patch_codes import GridLayout, buffer_bytes, encode, layout_of, layout_of_shapes, views
from pnv_core.types import ImageRef, PlaceDescriptor
from pnv_core.verify.feature_codes import unpack
from pnv_core.verify.local_features import features_of
from pnv_fleet.errors import FleetError

PRECISION = "int8"  # of the patches that travel
PART_CHARACTERS = 65_532  # of base64, under the 65,535 bytes of a VARCHAR of Milvus
PART_BYTES = PART_CHARACTERS // 4 * 3
MOST_PARTS = 48  # a collection of Milvus has at most 64 fields
MOST_DIM = 32_768  # of a vector of Milvus
MOST_PICTURE = 1 << 17
_MAGIC = b"PNVV"
_HEAD = struct.Struct("<4sIH")
_LARGEST_STAMP = 2**31 * 10**9  # what the messages of ROS hold
_NAME = re.compile(r"[A-Za-z0-9_.:/-]{1,64}")

META = ("robot", "session", "camera", "keyframe", "stamp_ns", "texture", "posed", "x", "y", "z")


@dataclass(frozen=True, eq=False)
class Place:
    """A keyframe of some robot. `session` is the stamp of its session's first keyframe, the same wherever it is sent.

    `position` is in the frame of the robot's own poses: comparable between robots only where they share one.
    `view` holds patches and features, empty where they were not fetched.
    """

    robot: str
    session: int
    camera: str
    keyframe: int
    stamp_ns: int
    texture: float
    vector: NDArray[np.float32]  # (D,)
    view: bytes = b""
    position: tuple[float, float, float] | None = None

    @property
    def key(self) -> str:
        """One camera of a robot takes one image at a time: sent twice, a keyframe is the same row."""
        return key_of(self.robot, self.camera, self.stamp_ns)

    @property
    def ref(self) -> ImageRef:
        """As closures name it; the session in whole seconds, which fits where sessions are counted."""
        return ImageRef(self.keyframe, self.stamp_ns, self.camera, self.session // 10**9, self.robot)


def key_of(robot: str, camera: str, stamp_ns: int) -> str:
    return hashlib.sha256(f"{robot}\n{camera}\n{stamp_ns}".encode()).hexdigest()[:32]


def robot_name(name: str) -> str:
    """The name, if it is one. Raises FleetError."""
    if not _NAME.fullmatch(name):
        raise FleetError(f"robot name {name!r}; allowed: 1 to 64 letters, digits, _ . : / -")
    return name


# Descriptors and their bytes


def encode_view(descriptor: PlaceDescriptor) -> bytes:
    """Patches in int8 and whatever the thumbnail holds."""
    layouts = layout_of(descriptor.patches, PRECISION)
    grids = [(g.size, g.rows, g.cols, g.stride, g.dim) for g in layouts]
    head = json.dumps({"precision": PRECISION, "grids": grids}, separators=(",", ":")).encode()
    body = head + encode(descriptor.patches, layouts).tobytes() + descriptor.thumbnail
    length = struct.pack("<H", len(head))
    return _MAGIC + struct.pack("<I", zlib.crc32(length + body)) + length + body


def without_picture(descriptor: PlaceDescriptor) -> PlaceDescriptor:
    """The same with the features alone of what was kept to verify it; what is neither features nor picture stays."""
    return replace(descriptor, thumbnail=features_of(descriptor.thumbnail))


def parts_of(layouts: tuple[GridLayout, ...]) -> int:
    """How many fields a view takes at most. Raises FleetError where a row cannot hold it."""
    most = buffer_bytes(layouts) + MOST_PICTURE
    parts = -(-most // PART_BYTES)
    if parts > MOST_PARTS:
        raise FleetError(
            f"the patches of a keyframe take {buffer_bytes(layouts) / 1e6:.1f} MB; allowed in a fleet: "
            f"{(MOST_PARTS * PART_BYTES - MOST_PICTURE) / 1e6:.1f} MB; choose the preset default, speed or storage"
        )
    return parts


def layouts_of(descriptor: PlaceDescriptor) -> tuple[GridLayout, ...]:
    return layout_of(descriptor.patches, PRECISION)


def decode_view(view: bytes, expected: tuple[GridLayout, ...] | None = None) -> tuple[tuple[GridLayout, ...], bytes]:
    """Layouts and buffer (patches, then features or picture) of a view. Raises FleetError for one not to be believed.

    `expected` are the layouts of this model's keyframes, where they are known.
    """
    length = _check(view)
    layouts = _layouts(view[_HEAD.size : _HEAD.size + length])
    if expected is not None and layouts != expected:
        raise FleetError("a view with patches of another shape than this model's")
    buffer = view[_HEAD.size + length :]
    picture = len(buffer) - buffer_bytes(layouts)
    if not 0 <= picture <= MOST_PICTURE:
        raise FleetError(f"a view of {len(buffer)} bytes; allowed: {buffer_bytes(layouts)} and features")
    for codes in views(np.frombuffer(buffer, np.uint8), layouts):
        if codes.scales is None or not np.isfinite(codes.scales).all() or not (np.abs(codes.scales) <= 1.0).all():
            raise FleetError("a view with patch scales that are no numbers within 1")
    picture_bytes = buffer[buffer_bytes(layouts) :]
    if picture_bytes.startswith(b"PNV"):  # features, here or of an older release
        try:
            unpack(picture_bytes)
        except ValueError as error:
            raise FleetError(f"a view with {error}") from None
    return layouts, buffer


def _check(view: bytes) -> int:
    """Length of the JSON of a view that is as it was written. Raises FleetError."""
    if len(view) < _HEAD.size or view[:4] != _MAGIC:
        raise FleetError(f"a view of {len(view)} bytes without its mark")
    _, crc, length = _HEAD.unpack_from(view)
    if zlib.crc32(memoryview(view)[8:]) != crc:
        raise FleetError("a view whose checksum is wrong")
    return int(length)


def _layouts(text: bytes) -> tuple[GridLayout, ...]:
    try:
        given = json.loads(text)
        precision, grids = given["precision"], given["grids"]
        shapes = [(int(size), int(rows), int(cols), int(stride), int(dim)) for size, rows, cols, stride, dim in grids]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise FleetError(f"a view without readable grids ({type(error).__name__})") from None
    whole = precision == PRECISION and len(shapes) <= 16
    # every factor is bounded before they are multiplied, and the product before a layout is made of it
    if not whole or any(not all(1 <= n <= 65_536 for n in shape) for shape in shapes):
        raise FleetError(f"a view of precision {str(precision)[:20]!r} with grids {str(shapes)[:100]}")
    total = sum(rows * cols * (dim + 4) for _, rows, cols, _, dim in shapes)
    if total > MOST_PARTS * PART_BYTES:
        raise FleetError(
            f"a view that says it holds {total / 1e6:.0f} MB; allowed: {MOST_PARTS * PART_BYTES / 1e6:.0f}"
        )
    return layout_of_shapes(shapes, precision)


def descriptor_of(place: Place, like: PlaceDescriptor) -> PlaceDescriptor:
    """The descriptor in a place's view, which is to have the shapes of another one. Raises FleetError."""
    layouts, buffer = decode_view(place.view, layouts_of(like))
    cells = [grid.cell for grid in like.patches]
    codes = views(np.frombuffer(buffer, np.uint8), layouts)
    picture = buffer[buffer_bytes(layouts) :]
    return PlaceDescriptor(
        place.vector, tuple(c.grid(cell) for c, cell in zip(codes, cells, strict=True)), place.texture, picture
    )


# Rows of the store


def to_row(place: Place, parts: int) -> dict[str, Any]:
    """The place as a row with so many view fields. Raises FleetError where it does not fit."""
    if len(place.view) > parts * PART_BYTES:
        raise FleetError(f"a keyframe of {len(place.view)} bytes; allowed in this collection: {parts * PART_BYTES}")
    x, y, z = place.position or (0.0, 0.0, 0.0)
    row: dict[str, Any] = {
        "key": place.key, "robot": place.robot, "session": place.session, "camera": place.camera,
        "keyframe": place.keyframe, "stamp_ns": place.stamp_ns, "texture": float(place.texture),
        "posed": place.position is not None, "x": float(x), "y": float(y), "z": float(z),
        "vector": np.asarray(place.vector, np.float32),
    }  # fmt: skip
    text = base64.b64encode(place.view).decode("ascii")
    for part in range(parts):
        row[f"view_{part}"] = text[part * PART_CHARACTERS : (part + 1) * PART_CHARACTERS]
    return row


def row_bytes(place: Place) -> int:
    """Bytes of a place on the wire, framing left out."""
    return 4 * len(place.vector) + -(-len(place.view) // 3) * 4 + 100


def from_row(row: Mapping[str, Any], dim: int, parts: int = 0) -> Place:
    """The place in a row, with its vector and view where they were fetched. Raises FleetError naming what is wrong."""
    robot, camera = row.get("robot"), row.get("camera")
    if not isinstance(robot, str) or not _NAME.fullmatch(robot):
        raise FleetError(f"a row of robot {str(robot)[:70]!r}; allowed: 1 to 64 letters, digits, _ . : / -")
    if not isinstance(camera, str) or len(camera) > 255 or not camera.isprintable():
        raise FleetError(
            f"a row of {robot} with a camera name of {len(str(camera))} characters; allowed: 255, printable"
        )
    session, keyframe, stamp = (_whole(row.get(name), robot, name) for name in ("session", "keyframe", "stamp_ns"))
    texture = _number(row.get("texture"), robot, "texture")
    if not 0.0 <= texture <= 1.0:
        raise FleetError(f"a row of {robot} with texture {texture:g}; allowed: 0 to 1")
    position = None
    if row.get("posed") is True:
        x, y, z = (_number(row.get(name), robot, name) for name in "xyz")
        position = (x, y, z)
    vector = np.zeros(0, np.float32)
    if "vector" in row:
        vector = _unit_vector(row["vector"], dim, robot)
    view = b"".join(_part(row.get(f"view_{part}"), robot) for part in range(parts))
    return Place(robot, session, camera, keyframe, stamp, texture, vector, view, position)


def _whole(value: Any, robot: str, name: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < _LARGEST_STAMP:
        raise FleetError(f"a row of {robot} with {name} = {str(value)[:30]}; allowed: 0 to {_LARGEST_STAMP}")
    return value


def _number(value: Any, robot: str, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, float | int) or not math.isfinite(value):
        raise FleetError(f"a row of {robot} with {name} = {str(value)[:30]}; allowed: a finite number")
    return float(value)


def _unit_vector(value: Any, dim: int, robot: str) -> NDArray[np.float32]:
    try:
        vector = np.asarray(value, np.float32)
    except (TypeError, ValueError):
        vector = np.zeros(0, np.float32)
    if vector.shape != (dim,) or not np.isfinite(vector).all() or abs(float(np.linalg.norm(vector)) - 1.0) > 1e-2:
        raise FleetError(f"a row of {robot} whose vector is no unit vector of {dim} numbers")
    return vector / np.linalg.norm(vector)


def _part(value: Any, robot: str) -> bytes:
    if not isinstance(value, str) or len(value) > PART_CHARACTERS:
        raise FleetError(f"a row of {robot} with a view part that is no text of at most {PART_CHARACTERS}")
    try:
        return base64.b64decode(value, validate=True)
    except (binascii.Error, ValueError):
        raise FleetError(f"a row of {robot} with a view part that is no base64") from None


# Bytes for the outbox


def to_bytes(place: Place) -> bytes:
    """The place for a file of this machine: JSON, vector, view."""
    head = json.dumps([place.robot, place.session, place.camera, place.keyframe, place.stamp_ns, place.texture,
                       place.position, len(place.vector)]).encode()  # fmt: skip
    return struct.pack("<I", len(head)) + head + np.asarray(place.vector, "<f4").tobytes() + place.view


def from_bytes(data: bytes) -> Place:
    """Raises FleetError for bytes that are no place."""
    try:
        (length,) = struct.unpack_from("<I", data)
        robot, session, camera, keyframe, stamp, texture, position, dim = json.loads(data[4 : 4 + length])
        if not 0 < dim <= MOST_DIM:
            raise ValueError(dim)
        vector = np.frombuffer(data, "<f4", dim, 4 + length)
        row = {"robot": robot, "session": session, "camera": camera, "keyframe": keyframe, "stamp_ns": stamp,
               "texture": texture, "posed": position is not None, "vector": vector}  # fmt: skip
        row |= dict(zip("xyz", position or (), strict=False))
    except (struct.error, ValueError, TypeError, RecursionError) as error:
        raise FleetError(f"a keyframe in the outbox is damaged ({type(error).__name__})") from None
    view = data[4 + length + 4 * dim :]
    _check(view)
    return replace(from_row(row, dim), view=view)

"""Segments: the files of a saved map that hold keyframes. Written once, never changed.

    segment = header record* header
    header  = "PNVS" version u32, length u32, crc32 u32, then `length` bytes of JSON (model, cameras, grid layouts)
    record  = "PNVK" crc32 u32, id i64, stamp i64, session i32, camera u16, layout u16, texture f64,
              payload length u64, payload crc32 u32, then the payload: vector (D,) float32 and the patch buffer

Little-endian. Every byte is under a checksum. The header stands at both ends and each record carries its magic, so
that what is whole can be found in a file that is not.
"""

import json
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedReader, FileIO
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from pnv_core.database.keyframes import KeyframeRecord
from pnv_core.database.patch_codes import GridLayout, buffer_bytes, layout_of_shapes, plausible
from pnv_core.errors import MapError
from pnv_core.files import open_regular
from pnv_core.types import ImageRef

VERSION = 1
_HEADER = struct.Struct("<4sIII")
_RECORD = struct.Struct("<4sIqqiHHdQI")
_CHECKED = slice(8, None)  # of a record's head: all after its own checksum
_HEADER_MAGIC, _RECORD_MAGIC = b"PNVS", b"PNVK"
_MOST_THUMBNAIL = 1 << 20  # bytes behind the patches; a picture of 320 pixels width takes about 2**14
_MOST_HEADER = 16_000_000  # bytes; more is damage, not a header
_MOST_SALVAGED = 2**32  # bytes of a file that is searched; a segment ends soon after 64 MB

Layouts = tuple[GridLayout, ...]
_Number = Annotated[int, msgspec.Meta(ge=1, le=1_000_000)]


@dataclass(frozen=True)
class _WrittenLayout:
    precision: Literal["float32", "float16", "int8"]
    grids: tuple[tuple[_Number, _Number, _Number, _Number, _Number], ...]  # size, rows, cols, stride, dim


@dataclass(frozen=True)
class _WrittenHeader:
    """A header as JSON holds it."""

    fingerprint: str
    dim: _Number
    cameras: Annotated[tuple[Annotated[str, msgspec.Meta(max_length=1000)], ...], msgspec.Meta(max_length=2**16)]
    layouts: Annotated[tuple[_WrittenLayout, ...], msgspec.Meta(max_length=2**16)]


@dataclass(frozen=True, eq=False)
class SavedKeyframe:
    """A keyframe as read from a segment: vector (D,) float32, patches in one buffer."""

    ref: ImageRef
    vector: NDArray[np.float32]
    layouts: Layouts
    buffer: NDArray[np.uint8]
    texture: float

    def read(self) -> NDArray[np.uint8]:
        return self.buffer

    @property
    def sound(self) -> bool:
        """Whether a describer may give this: a vector of length 1, patches of such values. No checksum says so."""
        length = float(np.linalg.norm(self.vector.astype(np.float64)))
        return abs(length - 1.0) < 1e-2 and plausible(self.buffer, self.layouts)


@dataclass(frozen=True)
class SegmentHeader:
    """What the records of a segment refer to."""

    fingerprint: str
    dim: int
    cameras: tuple[str, ...]
    layouts: tuple[Layouts, ...]

    def encode(self) -> bytes:
        body = json.dumps(
            {
                "fingerprint": self.fingerprint,
                "dim": self.dim,
                "cameras": self.cameras,
                "layouts": [
                    {
                        "precision": layouts[0].precision if layouts else "float32",
                        "grids": [(g.size, g.rows, g.cols, g.stride, g.dim) for g in layouts],
                    }
                    for layouts in self.layouts
                ],
            }
        ).encode()
        return _HEADER.pack(_HEADER_MAGIC, VERSION, len(body), zlib.crc32(body)) + body

    @classmethod
    def decode(cls, body: bytes) -> "SegmentHeader":
        """Raises ValueError for JSON that is no header."""
        try:
            given = msgspec.json.decode(body, type=_WrittenHeader)
        except (msgspec.DecodeError, RecursionError) as error:
            raise ValueError(f"no segment header: {error}") from error
        layouts = tuple(layout_of_shapes(item.grids, item.precision) for item in given.layouts)
        return cls(given.fingerprint, given.dim, given.cameras, layouts)

    def record_bytes(self, layout: int) -> int:
        """Bytes of a record's payload."""
        return 4 * self.dim + buffer_bytes(self.layouts[layout])


class SegmentWriter:
    """Writes one segment; `close` gives its size and digest once it is safely on the disk. Raises OSError."""

    def __init__(self, path: Path, header: SegmentHeader) -> None:
        self.path = path
        self.ids: list[int] = []
        self._header = header
        self._camera = {name: i for i, name in enumerate(header.cameras)}
        self._layout = {layouts: i for i, layouts in enumerate(header.layouts)}
        self._file = FileIO(path, "x")  # closed in close or abandon
        self.nbytes = 0
        self._digest = 0
        self._write(header.encode())

    def _write(self, *parts: bytes | memoryview) -> None:
        for part in parts:
            left = memoryview(part).cast("B")
            while left:
                left = left[self._file.write(left) :]
            self.nbytes += len(memoryview(part).cast("B"))

    def add(self, kf: KeyframeRecord) -> None:
        vector = np.ascontiguousarray(kf.vector, "<f4").tobytes()
        buffer = np.ascontiguousarray(kf.read(), np.uint8).data
        crc = zlib.crc32(buffer, zlib.crc32(vector))
        camera, layout = self._camera[kf.ref.camera], self._layout[kf.layouts]
        fields = (
            kf.ref.id,
            kf.ref.stamp_ns,
            kf.ref.session,
            camera,
            layout,
            kf.texture,
            len(vector) + len(buffer),
            crc,
        )
        head = _RECORD.pack(_RECORD_MAGIC, 0, *fields)
        head = _RECORD.pack(_RECORD_MAGIC, zlib.crc32(head[_CHECKED]), *fields)
        self._digest = zlib.crc32(head, self._digest)
        self._write(head, vector, buffer)
        self.ids.append(kf.ref.id)

    def close(self) -> int:
        """The digest: a checksum over all record heads, which hold the checksums of their payloads."""
        self._write(self._header.encode())
        os.fsync(self._file.fileno())
        self._file.close()
        return self._digest

    def abandon(self) -> None:
        self._file.close()
        self.path.unlink(missing_ok=True)


def open_segment(path: Path, nbytes: int) -> BufferedReader:
    """A segment of this size, open for reading. Raises MapError naming the file and what is wrong."""
    try:
        file = open_regular(path)
    except OSError as error:
        raise MapError(f"{path}: {error.strerror}; allowed: the segment the map names") from error
    size = os.fstat(file.fileno()).st_size
    if size != nbytes:
        file.close()
        raise MapError(f"{path}: {size} bytes; allowed: {nbytes}, as saved")
    return file


def read_segment(path: Path, file: BufferedReader, digest: int) -> Iterator[tuple[SegmentHeader, SavedKeyframe]]:
    """Every keyframe of an open segment of this digest, with its header; `path` names it in messages.

    Raises MapError for what is wrong.
    """
    try:
        file.seek(0)
        yield from _records(path, file, digest)
    except OSError as error:
        raise MapError(f"{path}: {error.strerror}; allowed: the segment the map names") from error


def _records(path: Path, file: BufferedReader, digest: int) -> Iterator[tuple[SegmentHeader, SavedKeyframe]]:
    first, header = _read_header(path, file)
    found = 0
    while True:
        at = file.tell()
        magic = file.read(4)
        file.seek(at)
        if magic == _HEADER_MAGIC:
            break
        head, keyframe = _read_record(path, file, header)
        found = zlib.crc32(head, found)
        yield header, keyframe
    last, _ = _read_header(path, file)
    if last != first or file.read(1):
        raise MapError(f"{path}: altered at its end")
    if found != digest:
        raise MapError(f"{path}: not the segment that was saved under this name (digest {found:08x} for {digest:08x})")


def _read_header(path: Path, file: BufferedReader) -> tuple[bytes, SegmentHeader]:
    at = file.tell()
    head = file.read(_HEADER.size)
    if len(head) < _HEADER.size:
        raise MapError(f"{path}: ends within a header at byte {at}")
    magic, version, length, crc = _HEADER.unpack(head)
    if magic != _HEADER_MAGIC:
        raise MapError(f"{path}: no segment header at byte {at}")
    if version != VERSION:
        raise MapError(f"{path}: segment format version {version}; allowed: {VERSION}")
    body = file.read(length) if length <= _MOST_HEADER else b""
    if len(body) != length or zlib.crc32(body) != crc:
        raise MapError(f"{path}: segment header at byte {at} is damaged")
    try:
        return head + body, SegmentHeader.decode(body)
    except ValueError as error:
        raise MapError(f"{path}: {error}") from error


def _read_record(path: Path, file: BufferedReader, header: SegmentHeader) -> tuple[bytes, SavedKeyframe]:
    at = file.tell()
    head = file.read(_RECORD.size)
    if len(head) < _RECORD.size:
        raise MapError(f"{path}: ends within a keyframe at byte {at}")
    parsed = _parse(head, header)
    if parsed is None:
        raise MapError(f"{path}: the head of the keyframe at byte {at} is damaged")
    if parsed.nbytes > os.fstat(file.fileno()).st_size:  # before so much is allocated
        raise MapError(f"{path}: keyframe {parsed.ref.id} at byte {at} is longer than the file")
    payload = np.empty(parsed.nbytes, np.uint8)
    if file.readinto(payload.data) != parsed.nbytes or zlib.crc32(payload.data) != parsed.crc:
        raise MapError(f"{path}: keyframe {parsed.ref.id} at byte {at} is damaged")
    return head, parsed.keyframe(payload, header)


@dataclass(frozen=True)
class _Head:
    ref: ImageRef
    layout: int
    texture: float
    nbytes: int
    crc: int

    def keyframe(self, payload: NDArray[np.uint8], header: SegmentHeader) -> SavedKeyframe:
        payload.flags.writeable = False
        vector = payload[: 4 * header.dim].view("<f4")
        return SavedKeyframe(self.ref, vector, header.layouts[self.layout], payload[4 * header.dim :], self.texture)


def _parse(head: bytes, header: SegmentHeader) -> _Head | None:
    """The head of a record; None if it is damaged or does not belong to the header."""
    magic, crc, keyframe, stamp, session, camera, layout, texture, nbytes, payload_crc = _RECORD.unpack(head)
    whole = magic == _RECORD_MAGIC and crc == zlib.crc32(head[_CHECKED])
    if not whole or camera >= len(header.cameras) or layout >= len(header.layouts):
        return None
    if not 0 <= nbytes - header.record_bytes(layout) <= _MOST_THUMBNAIL:
        return None
    if not (0 <= keyframe < 2**53 and 0 <= session < 2**31 - 1 and 0.0 <= texture <= 1.0):
        return None
    ref = ImageRef(keyframe, stamp, header.cameras[camera], session)
    return _Head(ref, layout, texture, nbytes, payload_crc)


def salvage(path: Path) -> tuple[SegmentHeader | None, list[SavedKeyframe]]:
    """Every whole keyframe of a damaged segment, and its header if one of the two is whole. Raises OSError."""
    with open_regular(path) as file:
        data = file.read(_MOST_SALVAGED)
    header = _salvage_header(data)
    if header is None:
        return None, []
    keyframes = []
    at = data.find(_RECORD_MAGIC)
    while at >= 0:
        keyframe, end = _salvage_record(data, at, header)
        if keyframe is not None:
            keyframes.append(keyframe)
        at = data.find(_RECORD_MAGIC, end)
    return header, keyframes


def _salvage_header(data: bytes) -> SegmentHeader | None:
    at = data.find(_HEADER_MAGIC)
    while at >= 0:
        if len(data) - at >= _HEADER.size:
            _, version, length, crc = _HEADER.unpack_from(data, at)
            body = data[at + _HEADER.size :][:length] if length <= _MOST_HEADER else b""
            if version == VERSION and len(body) == length and zlib.crc32(body) == crc:
                try:
                    return SegmentHeader.decode(body)
                except ValueError:
                    pass
        at = data.find(_HEADER_MAGIC, at + 1)
    return None


def _salvage_record(data: bytes, at: int, header: SegmentHeader) -> tuple[SavedKeyframe | None, int]:
    """The keyframe at this byte if it is whole, and where to look on."""
    head = data[at : at + _RECORD.size]
    parsed = _parse(head, header) if len(head) == _RECORD.size else None
    if parsed is None:
        return None, at + 1
    start = at + _RECORD.size
    payload = np.frombuffer(data[start : start + parsed.nbytes], np.uint8).copy()
    if len(payload) != parsed.nbytes or zlib.crc32(payload.data) != parsed.crc:
        return None, at + 1
    keyframe = parsed.keyframe(payload, header)
    return (keyframe if keyframe.sound else None), start + parsed.nbytes

"""KeyframeDatabase. N = keyframes, D = dimension of the global vector."""

import contextlib
import copy
import ctypes
import logging
import struct
import threading
import time
from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from pnv_core.database.eviction import make_eviction
from pnv_core.database.index import CATCH_UP, EXACT_BYTES, INDICES, PqIndex
from pnv_core.database.patch_codes import (
    DTYPES,
    GridLayout,
    PatchCodes,
    Shapes,
    buffer_bytes,
    encode,
    layout_of,
    shapes_of,
    views,
)
from pnv_core.database.patch_file import DiskBuffer, PatchFile
from pnv_core.database.vectors import Allowed, Row, VectorTable
from pnv_core.errors import ConfigError, PnvError
from pnv_core.types import ImageRef, PlaceDescriptor

if TYPE_CHECKING:
    from pnv_core.describe.describer import Describer

MB = 1_000_000
_COUNTS = ("read_only", "_evicted", "_unreadable")  # of a database that goes on when its contents are replaced
# Python objects of one keyframe (record, reference, row, buffer header, places in dicts and in the eviction policy)
OBJECT_BYTES = 2000
_GEOMETRY_END, _GEOMETRY_MARK = struct.Struct("<I8s"), b"PNVGend\x00"

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class StoredKeyframe:
    """A keyframe as the database holds it. Never changed, so that a snapshot may be read by another thread."""

    __slots__ = ("buffer", "layouts", "ref", "row", "texture", "vector")

    ref: ImageRef
    vector: NDArray[np.float32]  # (D,), a row of the vector table, valid while `row` lives
    row: Row
    layouts: tuple[GridLayout, ...]
    buffer: NDArray[np.uint8] | DiskBuffer  # the patches, the thumbnail, what is known for poses
    texture: float

    def read(self) -> NDArray[np.uint8]:
        """The patches' buffer, from disk if it lies there. Raises OSError."""
        return self.buffer.read() if isinstance(self.buffer, DiskBuffer) else self.buffer

    def patches(self) -> tuple[PatchCodes, ...]:
        return views(self.read(), self.layouts)

    def descriptor(self, cell: int) -> PlaceDescriptor:
        """`cell` is the trunk's stride, the same for every keyframe of a model."""
        buffer = self.read()
        patches = tuple(codes.grid(cell) for codes in views(buffer, self.layouts))
        return PlaceDescriptor(self.vector.copy(), patches, self.texture, *_parted(buffer, self.layouts))


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The database at one moment, for saving in another thread while frames go on."""

    lineage: object  # the same for snapshots of one database between loads: an id then means one keyframe
    dim: int
    next_id: int
    next_session: int
    keyframes: list[StoredKeyframe]  # by ascending id


@dataclass(frozen=True)
class DatabaseStats:
    """What the database holds and what it gave up."""

    keyframes: int
    bytes_used: int
    bytes_budget: int
    evicted: int
    sessions: int
    disk_bytes: int = 0
    without_picture: int = 0  # keyframes that local features cannot examine
    unreadable: int = 0  # keyframes given up because the disk could not read them


def bytes_needed(dim: int, keyframes: int, patch_bytes: int) -> int:
    """Bytes a database with `index: auto` counts once so many keyframes are in, each row in use."""
    table = VectorTable(1, dim)
    used = patch_bytes + keyframes * (table.row_bytes + OBJECT_BYTES)
    scanned = 8 * dim * keyframes > EXACT_BYTES and dim % 2 == 0
    return used + (PqIndex(table).nbytes(keyframes + CATCH_UP) if scanned else 0)


class KeyframeRecord(Protocol):
    """A keyframe that can be saved or restored: one of the database, or one read from a map."""

    @property
    def ref(self) -> ImageRef: ...

    @property
    def vector(self) -> NDArray[np.float32]: ...

    @property
    def layouts(self) -> tuple[GridLayout, ...]: ...

    @property
    def texture(self) -> float: ...

    def read(self) -> NDArray[np.uint8]: ...


class KeyframeDatabase:
    """Keyframes by id, searched by global vector, within a hard budget of memory.

    Adding and querying belong to one thread; `snapshot` and `stats` may be called from any other. Ids count upwards
    over all sessions and are never reused. No clock: age is the image stamp.
    """

    def __init__(
        self,
        dim: int,
        memory_budget_mb: float = 1024.0,
        eviction: str = "oldest",
        index: str = "auto",
        patch_store: str = "memory",
        patch_precision: str = "float16",
        read_only: bool = False,
        patch_folder: str = "",
        disk_budget_gb: float = 32.0,
        cell: int = 16,
        shapes: Shapes | None = None,
    ) -> None:
        if patch_precision not in DTYPES:
            allowed = ", ".join(DTYPES)
            raise ConfigError(f"patch_precision = {patch_precision!r} is out of range; allowed: one of {allowed}")
        if patch_store not in ("memory", "disk"):
            raise ConfigError(f"patch_store = {patch_store!r} is out of range; allowed: one of memory, disk")
        self.dim = dim
        self.cell = cell
        self.shapes = shapes  # of the patches of every keyframe; None: any
        self.bytes_budget = int(memory_budget_mb * MB)
        self.patch_precision = patch_precision
        self.read_only = read_only
        self._eviction_name = eviction
        self._index_name = index
        self._new_file = lambda: PatchFile(patch_folder, int(disk_budget_gb * 1e9)) if patch_store == "disk" else None
        self._patch_file = self._new_file()
        self._disk_failed = False
        self._lock = threading.Lock()
        self._session = 0
        self._next_id = 0
        self._evicted = 0
        self._unreadable = 0
        self._layouts: dict[tuple[GridLayout, ...], tuple[GridLayout, ...]] = {}
        self._start_empty()

    def _start_empty(self) -> None:
        self._lineage = object()
        self._eviction = make_eviction(self._eviction_name)
        most = self.bytes_budget // (self.dim * 4 + OBJECT_BYTES) + 1
        self._table = VectorTable(2 * most, self.dim)  # twice: a snapshot may hold on to every row it saw
        self._index = INDICES.make(self._index_name, self._table)
        self._in_memory: dict[int, None] = {}  # ids whose patches are in memory, oldest first
        self._keyframes: dict[int, StoredKeyframe] = {}
        self._ids: list[int] = []  # ascending
        self._sequences: dict[tuple[int, str], list[int]] = {}  # ascending ids by (session, camera)
        self._cameras: dict[str, int] = {}
        self._patch_bytes = 0
        self._pictures = 0

    @classmethod
    def for_describer(cls, describer: "Describer", *, read_only: bool = False) -> "KeyframeDatabase":
        """An empty database for what this describer gives, with the memory settings of its Config."""
        config, depth = describer.config, describer.model.patch_dim
        return cls(
            describer.model.global_dim,
            cell=describer.cell,
            shapes=tuple((size, rows, cols, stride, depth) for size, stride, rows, cols in describer.grids()),
            memory_budget_mb=config.memory_budget_mb,
            eviction=config.eviction,
            index=config.index,
            patch_store=config.patch_store,
            patch_precision=config.patch_precision,
            read_only=read_only,
            patch_folder=config.patch_folder,
            disk_budget_gb=config.disk_budget_gb,
        )

    def __len__(self) -> int:
        return len(self._ids)

    def __contains__(self, keyframe: int) -> bool:
        return keyframe in self._keyframes

    @property
    def session(self) -> int:
        """Number of the session that new keyframes belong to."""
        return self._session

    @property
    def bytes_used(self) -> int:
        """Bytes of vectors, patches and index, and an allowance for the objects that hold them."""
        return self._bytes_with(0)

    def _bytes_with(self, more: int) -> int:
        """Bytes used once `more` further keyframes without patches are in."""
        return (
            self._patch_bytes
            + (len(self._ids) + more) * OBJECT_BYTES
            + self._table.nbytes(more)
            + self._index.nbytes(more)
        )

    @property
    def evicted(self) -> int:
        """Keyframes given up so far to stay within the budget."""
        return self._evicted

    def bytes_per_keyframe(self, descriptor: PlaceDescriptor) -> int:
        """Bytes this keyframe would take, known before it is added."""
        patches = buffer_bytes(layout_of(descriptor.patches, self.patch_precision))
        return self._table.row_bytes + OBJECT_BYTES + patches + len(_joined(descriptor))

    def stats(self) -> DatabaseStats:
        with self._lock:
            return DatabaseStats(
                keyframes=len(self._ids),
                bytes_used=self.bytes_used,
                bytes_budget=self.bytes_budget,
                evicted=self._evicted,
                sessions=len(np.unique(self._table.sessions[: self._table.high][self._table.live[: self._table.high]])),
                disk_bytes=self._patch_file.end if self._patch_file else 0,
                without_picture=len(self._ids) - self._pictures,
                unreadable=self._unreadable,
            )

    def add(self, stamp_ns: int, camera: str, descriptor: PlaceDescriptor) -> ImageRef:
        """Remember an image under the next id, giving up others first where the budget asks for it.

        Raises PnvError when read-only, for a vector that is not unit (D,), or for a keyframe larger than the budget.
        """
        if self.read_only:
            raise PnvError("the database is read-only (localisation mode); allowed: queries")
        vector = _unit_vector(descriptor.global_vector, self.dim)
        layouts = self._shared(layout_of(descriptor.patches, self.patch_precision))
        buffer = encode(descriptor.patches, layouts)
        if rest := _joined(descriptor):
            buffer = np.concatenate([buffer, np.frombuffer(rest, np.uint8)])
            buffer.flags.writeable = False
        with self._lock:
            self._make_room(len(buffer))
            ref = ImageRef(self._next_id, stamp_ns, camera, self._session)
            self._next_id += 1
            self._insert(ref, vector, layouts, buffer, descriptor.texture)
        return ref

    def _make_room(self, patch_bytes: int) -> None:
        need = OBJECT_BYTES + self._table.row_bytes + patch_bytes
        if need > self.bytes_budget:
            raise PnvError(
                f"one keyframe takes {need / MB:.3g} MB; memory_budget_mb = {self.bytes_budget / MB:g} given"
            )
        while self._bytes_with(1) + patch_bytes > self.bytes_budget:
            if self._spill():
                continue
            if self._ids:
                self._remove(self._eviction.choose())
                self._evicted += 1
            else:
                self._start_empty()  # rows and codes of smaller keyframes than this one filled the budget

    def _spill(self) -> bool:
        """Move the oldest patches in memory to disk, if that is allowed and possible."""
        if self._patch_file is None or not self._in_memory:
            return False
        keyframe = next(iter(self._in_memory))
        stored = self._keyframes[keyframe]
        try:
            place = self._patch_file.write(stored.read())
        except OSError as error:
            if not self._disk_failed:
                _log.warning("patches stay in memory: %s: %s", self._patch_file.folder, error.strerror)
            self._disk_failed = True
            return False
        if place is None:
            return False
        self._keyframes[keyframe] = replace(stored, buffer=place)
        self._patch_bytes -= place.nbytes
        del self._in_memory[keyframe]
        return True

    def _insert(
        self,
        ref: ImageRef,
        vector: NDArray[np.float32],
        layouts: tuple[GridLayout, ...],
        buffer: NDArray[np.uint8],
        texture: float,
    ) -> None:
        camera = self._cameras.setdefault(ref.camera, len(self._cameras))
        row = self._table.add(vector, ref.id, ref.stamp_ns, ref.session, camera)
        kept = self._table.vectors[row.slot]
        self._keyframes[ref.id] = StoredKeyframe(ref, kept, row, layouts, buffer, texture)
        self._ids.append(ref.id)
        self._sequences.setdefault((ref.session, ref.camera), []).append(ref.id)
        self._patch_bytes += len(buffer)
        self._pictures += len(buffer) > buffer_bytes(layouts)
        self._in_memory[ref.id] = None
        self._index.add(row.slot)
        self._eviction.added(ref, kept)

    def _remove(self, keyframe: int) -> None:
        stored = self._keyframes.pop(keyframe)
        del self._ids[bisect_left(self._ids, keyframe)]
        sequence = self._sequences[stored.ref.session, stored.ref.camera]
        del sequence[bisect_left(sequence, keyframe)]
        self._pictures -= stored.buffer.nbytes > buffer_bytes(stored.layouts)
        if keyframe in self._in_memory:
            self._patch_bytes -= stored.buffer.nbytes
            del self._in_memory[keyframe]
        self._index.remove(stored.row.slot)
        self._eviction.removed(stored.ref)
        self._table.remove(stored.row)

    def _shared(self, layouts: tuple[GridLayout, ...]) -> tuple[GridLayout, ...]:
        return self._layouts.setdefault(layouts, layouts)

    def nearest(
        self,
        vector: NDArray[np.float32],
        k: int,
        stamp_ns: int,
        exclude_recent_ns: int,
        camera: str | None = None,
    ) -> list[tuple[ImageRef, float]]:
        """The k keyframes most similar to a unit vector (D,), with their cosine, best first; equal ones by id.

        Keyframes of the current session younger than `stamp_ns - exclude_recent_ns` are left out; those of other
        sessions never are. `camera` restricts the search to one camera.
        """
        query = _unit_vector(vector, self.dim)
        number = None if camera is None else self._cameras.get(camera, -1)
        allowed = Allowed(self._table, self._session, stamp_ns - exclude_recent_ns, number)
        slots = self._index.search(query, k, allowed)
        # once more, row by row: equal vectors then have equal similarities wherever they lie, and ids break the tie
        similarity = np.clip((self._table.vectors[slots] * query).sum(axis=1), -1.0, 1.0)
        ids = self._table.ids[slots]
        best = np.lexsort((ids, -similarity))[:k]
        return [(self._keyframes[int(ids[i])].ref, float(similarity[i])) for i in best]

    def ref(self, keyframe: int) -> ImageRef:
        """Raises KeyError for an id that is not, or no longer, in the database."""
        return self._keyframes[keyframe].ref

    def descriptor(self, keyframe: int) -> PlaceDescriptor:
        """What is stored of a keyframe; its patches are float16 when stored as float16, float32 otherwise."""
        return self._keyframes[keyframe].descriptor(self.cell)

    def readable(self, keyframes: Iterable[int]) -> dict[int, PlaceDescriptor]:
        """What is stored of these keyframes. One that the disk cannot read is given up, counted and said."""
        found = {}
        for keyframe in keyframes:
            try:
                found[keyframe] = self.descriptor(keyframe)
            except OSError as error:
                with self._lock:
                    self._remove(keyframe)
                    self._unreadable += 1
                _log.warning("keyframe %d is given up: %s", keyframe, error)
        return found

    def picture(self, keyframe: int) -> bytes:
        """What is kept of a keyframe to verify it; empty where nothing is, or the keyframe is gone or unreadable."""
        return self._rest(keyframe)[0]

    def geometry(self, keyframe: int) -> bytes:
        """What is kept of a keyframe for poses; empty where nothing is, or the keyframe is gone or unreadable."""
        return self._rest(keyframe)[1]

    def _rest(self, keyframe: int) -> tuple[bytes, bytes]:
        stored = self._keyframes.get(keyframe)
        try:
            return (b"", b"") if stored is None else _parted(stored.read(), stored.layouts)
        except OSError:
            return b"", b""

    def patches(self, keyframe: int) -> tuple[PatchCodes, ...]:
        """The patches of a keyframe exactly as stored, one PatchCodes per patch size (int8 with its scales)."""
        return self._keyframes[keyframe].patches()

    def vector(self, keyframe: int) -> NDArray[np.float32]:
        """The global vector (D,) of a keyframe."""
        return self._keyframes[keyframe].vector.copy()

    def neighbours(self, keyframe: int, reach: int) -> list[ImageRef]:
        """Up to `reach` keyframes before and after this one, of its session and camera, in order of id, without it."""
        centre = self._keyframes[keyframe].ref
        at = bisect_left(self._ids, keyframe)
        before = self._walk(range(at - 1, -1, -1), centre, reach)
        after = self._walk(range(at + 1, len(self._ids)), centre, reach)
        return before[::-1] + after

    def _walk(self, places: range, centre: ImageRef, reach: int) -> list[ImageRef]:
        found: list[ImageRef] = []
        for place in places:
            ref = self._keyframes[self._ids[place]].ref
            if len(found) == reach or ref.session != centre.session:
                break
            if ref.camera == centre.camera:
                found.append(ref)
        return found

    def steps(self, earlier: ImageRef, later: ImageRef) -> int:
        """How many keyframes the camera of `earlier` went on to `later`, of the same session; negative backwards.

        Counted in the keyframes that are left, so that neither other cameras nor a thinned map make a way longer.
        Of sequences that are not here (another robot's), in ids.
        """
        sequence = self._sequences.get((earlier.session, earlier.camera), [])
        if earlier.robot or later.robot or not sequence:
            return later.id - earlier.id
        return bisect_left(sequence, later.id) - bisect_left(sequence, earlier.id)

    def first(self) -> ImageRef | None:
        """The keyframe of the lowest id, if any."""
        return self._keyframes[self._ids[0]].ref if self._ids else None

    def last(self) -> ImageRef | None:
        """The keyframe added last, if any."""
        return self._keyframes[self._ids[-1]].ref if self._ids else None

    def refs(self) -> list[ImageRef]:
        """Every keyframe, by ascending id."""
        with self._lock:
            return [self._keyframes[i].ref for i in self._ids]

    def new_session(self) -> int:
        """Begin another run: later keyframes belong to a session of their own. Gives its number."""
        with self._lock:
            self._session += 1
            return self._session

    def clear(self) -> None:
        """Forget every keyframe; ids go on counting."""
        with self._lock:
            before = self._keyframes
            self._start_empty()
        _let_go(before)

    def snapshot(self) -> Snapshot:
        """The database at this moment; costs a list, not a copy of the keyframes."""
        with self._lock:
            keyframes = [self._keyframes[i] for i in self._ids]
            return Snapshot(self._lineage, self.dim, self._next_id, self._session + 1, keyframes)

    def prepared(
        self, keyframes: Iterable[KeyframeRecord], count: int, next_id: int, next_session: int
    ) -> "KeyframeDatabase":
        """A database like this one with the `count` keyframes of a saved map, by ascending id, for `become`.

        This one is not touched and may be in use meanwhile. Raises PnvError when they exceed the budget.
        """
        fresh = copy.copy(self)
        fresh._patch_file = self._new_file()
        fresh._start_empty()
        for kf in keyframes:
            fresh._take_back(kf, count)
        fresh._next_id, fresh._session = next_id, next_session
        return fresh

    def become(self, prepared: "KeyframeDatabase") -> object:
        """Take over the contents of a `prepared` database at once. Gives the lineage of later snapshots."""
        with self._lock:
            before = self._keyframes
            vars(self).update(vars(prepared) | {n: vars(self)[n] for n in _COUNTS})
            lineage = self._lineage
        _let_go(before)
        return lineage

    def _take_back(self, kf: KeyframeRecord, count: int) -> None:
        if self.shapes is not None and shapes_of(kf.layouts) != self.shapes:
            raise PnvError(
                f"keyframe {kf.ref.id} has patches of size, rows, columns, stride and dimensions "
                f"{shapes_of(kf.layouts)}; allowed: {self.shapes}, as this model's"
            )
        buffer = np.frombuffer(kf.read(), np.uint8)
        while self._bytes_with(1) + len(buffer) > self.bytes_budget:
            if not self._spill():
                raise PnvError(
                    f"{len(self._ids)} of the map's {count} keyframes fill memory_budget_mb = "
                    f"{self.bytes_budget / MB:g}; allowed: a larger budget, patch_store = disk, or a pruned map"
                )
        self._insert(kf.ref, kf.vector, self._shared(kf.layouts), buffer, kf.texture)


def _joined(descriptor: PlaceDescriptor) -> bytes:
    """What stands behind the patches: the thumbnail, and for poses whatever is known, its length and a mark.

    Without a thumbnail nothing does: no pose is found without matches.
    """
    if not descriptor.thumbnail or not descriptor.geometry:
        return descriptor.thumbnail
    return descriptor.thumbnail + descriptor.geometry + _GEOMETRY_END.pack(len(descriptor.geometry), _GEOMETRY_MARK)


def _parted(buffer: NDArray[np.uint8], layouts: tuple[GridLayout, ...]) -> tuple[bytes, bytes]:
    """Thumbnail and geometry of a keyframe's buffer."""
    rest = buffer[buffer_bytes(layouts) :].tobytes()
    if len(rest) >= _GEOMETRY_END.size:
        length, mark = _GEOMETRY_END.unpack_from(rest, len(rest) - _GEOMETRY_END.size)
        start = len(rest) - _GEOMETRY_END.size - length
        if mark == _GEOMETRY_MARK and start > 0:
            return rest[:start], rest[start : start + length]
    return rest, b""


def _let_go(keyframes: dict[int, StoredKeyframe]) -> None:
    """Free keyframes bit by bit, so that no thread waits for all of them at once.

    glibc holds what is freed below a block in use, and unmaps all of it in one call, under Python's lock, when that
    block is freed, in whatever thread: 200 ms for 1 GB.
    """
    while keyframes:
        keyframes.popitem()
        if len(keyframes) % 64 == 0:
            _give_back_memory()


def _give_back_memory() -> None:
    """Freed memory to the system, without Python's lock."""
    with contextlib.suppress(OSError, AttributeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)
    time.sleep(0)


def _unit_vector(vector: NDArray, dim: int) -> NDArray[np.float32]:
    vector = np.asarray(vector, np.float32)
    if vector.shape != (dim,):
        raise PnvError(f"global vector of shape {vector.shape} given; allowed: ({dim},)")
    norm = float(np.sqrt(vector @ vector))
    if not abs(norm - 1.0) < 1e-3:
        raise PnvError(f"global vector of length {norm:g} given; allowed: a unit vector")
    return vector

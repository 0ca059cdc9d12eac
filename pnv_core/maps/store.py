"""MapStore: a map on disk that a running recogniser saves into and loads from.

A map is a folder: segments of keyframes that are written once, and a manifest that names those which make up the map.
A save writes only what is not on disk yet, then replaces the manifest. Until that moment the map is the one before;
from it on, the new one. Files that no manifest names are leftovers and are removed by the next save.
"""

import fcntl
import os
import re
from bisect import bisect
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

from pnv_core.database import KeyframeDatabase, Snapshot
from pnv_core.database.keyframes import KeyframeRecord
from pnv_core.errors import MapError
from pnv_core.files import sync_folder
from pnv_core.maps.manifest import (
    LAST_GENERATION,
    NAME,
    SEGMENT_NAME,
    Manifest,
    NotFlushed,
    Runs,
    Segment,
    Session,
    ids_of,
    read_manifest,
    runs_of,
    write_manifest,
)
from pnv_core.maps.reading import open_map
from pnv_core.maps.segment import SavedKeyframe, SegmentHeader, SegmentWriter
from pnv_core.types import ImageRef

SEGMENT_BYTES = 64_000_000  # a segment is closed beyond this, so that a rolling map frees disk in small steps
_SMALL_BYTES, _MANY_SMALL = 8_000_000, 16  # so many segments smaller than this are written anew as one
_LOCK = "lock"
_OURS = re.compile(SEGMENT_NAME + "|" + re.escape(NAME) + r"(\.new)?|" + _LOCK)


@dataclass(frozen=True)
class SaveReport:
    """What a save did."""

    path: Path
    keyframes: int
    written: int  # keyframes written anew
    bytes_written: int
    unreadable: int = 0  # keyframes left out because the disk could not read their patches
    kept: Path | None = None  # where the map is now that was there before and that this one does not continue

    def __str__(self) -> str:
        kept = "" if self.kept is None else f"; the map before a reset or load is kept at {self.kept}"
        lost = f"; {self.unreadable} unreadable ones are left out" if self.unreadable else ""
        size = f"{self.bytes_written / 1e6:.1f} MB"
        return f"{self.path}: {self.keyframes} keyframes, {self.written} new ({size}){lost}{kept}"


class MapStore:
    """A map folder bound to a model's fingerprint.

    `save` may run in any one thread while frames go on; it writes the difference to what it loaded or saved before.
    A map on disk that this store has neither loaded nor saved is not overwritten unless `replace`.
    """

    def __init__(self, path: str | os.PathLike[str], fingerprint: str, *, replace: bool = False) -> None:
        self.path = Path(path).absolute()  # a program that changes its folder later saves to the same map
        self.fingerprint = fingerprint
        self._replace = replace
        self._known: Manifest | None = None  # what is on disk, as far as this store knows
        self._lineage: object = None  # of the snapshot that `_known` holds

    def exists(self) -> bool:
        """Whether a save was completed there."""
        return (self.path / NAME).exists()

    def load(self, database: KeyframeDatabase) -> Manifest:
        """Verify the whole map, then replace the database's contents by it and begin a new session.

        Raises MapError for a map that is damaged or of another model, PnvError for one beyond the memory budget; the
        database is then as it was. Until the map is whole in memory the one before is held as well.
        """
        manifest, prepared = self.read(database)
        self.put(database, manifest, prepared)
        return manifest

    def read(self, database: KeyframeDatabase) -> tuple[Manifest, KeyframeDatabase]:
        """The map on disk as a database like this one, which stays as it is and in use. Raises as `load` does."""
        with open_map(self.path) as opened:
            manifest = opened.manifest
            if manifest.fingerprint != self.fingerprint:
                raise MapError(
                    f"{self.path} was made with model {manifest.fingerprint}; this is model {self.fingerprint}; "
                    "allowed: a map of the same model, image size and patch sizes"
                )
            if manifest.dim != database.dim:
                raise MapError(f"{self.path} has vectors of {manifest.dim} dimensions; allowed: {database.dim}")
            return manifest, database.prepared(
                opened.keyframes(), manifest.keyframes, manifest.next_id, manifest.next_session
            )

    def put(self, database: KeyframeDatabase, manifest: Manifest, prepared: KeyframeDatabase) -> None:
        """Replace the database's contents by what `read` gave."""
        self._lineage = database.become(prepared)
        self._known = manifest

    def save(self, snapshot: Snapshot) -> SaveReport:
        """Make the map on disk equal to the snapshot, which is used up.

        A map of this store that the snapshot does not continue, because the database was emptied or loaded from
        elsewhere, is kept in a folder beside it. Raises MapError (no space, no permission, a map not to be
        overwritten, another process saving); the map saved before is then as it was.
        """
        with locked(self.path):
            known, before = self._known_on_disk(snapshot)
            try:
                kept = _kept_aside(self.path, before) if before is not None else None
                manifest, report = self._write(snapshot, known)
            except OSError as error:
                raise MapError(
                    f"cannot save {self.path}: {error.strerror or error}; what was saved before is whole"
                ) from error
        self._known, self._lineage = manifest, snapshot.lineage
        return replace(report, kept=kept)

    def _known_on_disk(self, snapshot: Snapshot) -> tuple[Manifest | None, Manifest | None]:
        """The map on disk if the snapshot continues it, else None; and the one to be kept beside, if any."""
        if not self.exists():
            return None, None
        on_disk = read_manifest(self.path)
        if on_disk == self._known:
            continued = self._lineage is snapshot.lineage
            return (on_disk, None) if continued else (None, on_disk if on_disk.keyframes else None)
        if not self._replace:
            raise MapError(
                f"{self.path} holds a map of {on_disk.keyframes} keyframes that was not loaded; "
                "allowed: load it first, another path, or replace"
            )
        return None, None

    def _write(self, snapshot: Snapshot, known: Manifest | None) -> tuple[Manifest, SaveReport]:
        live: dict[int, KeyframeRecord] = {kf.ref.id: kf for kf in snapshot.keyframes}
        snapshot.keyframes.clear()  # from here on a keyframe is let go once written
        kept = _kept_segments(known.segments if known else (), live)
        refs = {i: kf.ref for i, kf in live.items()}
        cameras = tuple(dict.fromkeys(ref.camera for ref in refs.values()))
        for segment in kept:
            for i in ids_of(segment.live):
                del live[i]
        unsaved = len(live)
        unchanged = known is not None and not unsaved and kept == list(known.segments)
        if (
            unchanged
            and known is not None
            and (known.next_id, known.next_session) == (snapshot.next_id, snapshot.next_session)
        ):
            return known, SaveReport(self.path, len(refs), 0, 0)
        generation = _next_generation(self.path)
        header = SegmentHeader(
            self.fingerprint, snapshot.dim, cameras, tuple({kf.layouts: None for kf in live.values()})
        )
        borders = [_first_id(segment) for segment in kept]
        unreadable: list[int] = []
        written = write_segments(self.path, generation, header, _drain(live, unreadable), borders)
        for i in unreadable:
            del refs[i]
        manifest = Manifest(
            self.fingerprint,
            snapshot.dim,
            generation,
            snapshot.next_id,
            snapshot.next_session,
            len(refs),
            cameras,
            sessions_of(refs.values()),
            tuple(sorted((*kept, *written), key=_first_id)),
        )
        try:
            commit(self.path, manifest, written)
        except NotFlushed:
            self._known, self._lineage = manifest, snapshot.lineage  # it is in place, and this run goes on with it
            raise
        new = unsaved - len(unreadable)
        return manifest, SaveReport(self.path, len(refs), new, sum(s.bytes for s in written), len(unreadable))


def _drain(live: dict[int, KeyframeRecord], unreadable: list[int]) -> Iterator[SavedKeyframe]:
    """The keyframes one by one, read before anything is written of them; the ids of those that cannot be are noted."""
    for i in list(live):
        kf = live.pop(i)
        try:
            buffer = kf.read()
        except OSError:
            unreadable.append(i)
            continue
        yield SavedKeyframe(kf.ref, kf.vector, kf.layouts, buffer, kf.texture)


def _kept_segments(segments: Iterable[Segment], live: dict[int, KeyframeRecord]) -> list[Segment]:
    """Those worth keeping on disk: at least half alive, and not one of many small ones."""
    kept = []
    for s in segments:
        ids = ids_of(s.ids)
        alive = [i for i in ids if i in live]
        if alive and 2 * len(alive) >= len(ids):
            kept.append(Segment(s.file, s.bytes, s.digest, s.ids, runs_of(alive)))
    small = 0  # at the end, where every save adds one
    while small < len(kept) and kept[-1 - small].bytes < _SMALL_BYTES:
        small += 1
    return kept[: len(kept) - small] if small >= _MANY_SMALL else kept


def _first_id(segment: Segment) -> int:
    return segment.ids[0][0]


def sessions_of(refs: Iterable[ImageRef]) -> tuple[Session, ...]:
    """The sessions of these keyframes."""
    found: dict[int, list[int]] = {}
    for ref in refs:
        known = found.setdefault(ref.session, [0, ref.stamp_ns, ref.stamp_ns])
        known[0] += 1
        known[1], known[2] = min(known[1], ref.stamp_ns), max(known[2], ref.stamp_ns)
    return tuple(Session(number, *found[number]) for number in sorted(found))


def write_segments(
    folder: Path,
    generation: int,
    header: SegmentHeader,
    keyframes: Iterable[KeyframeRecord],
    borders: Sequence[int] = (),
) -> list[Segment]:
    """Write keyframes (ascending ids) into as many new segments as they need. Raises OSError, leaving none behind.

    No segment reaches over a border (ascending first ids of segments that stay), so that the ids of segments never
    interleave and a map is read in order of ids.
    """
    done: list[Segment] = []
    writer: SegmentWriter | None = None
    try:
        for kf in keyframes:
            if writer is not None and bisect(borders, writer.ids[-1]) != bisect(borders, kf.ref.id):
                done.append(_closed(writer))
                writer = None
            if writer is None:
                writer = SegmentWriter(folder / f"segment-{generation:08d}-{len(done):04d}.pnv", header)
            writer.add(kf)
            if writer.nbytes > SEGMENT_BYTES:
                done.append(_closed(writer))
                writer = None
        if writer is not None:
            done.append(_closed(writer))
    except BaseException:
        if writer is not None:
            writer.abandon()
        _remove(folder, [s.file for s in done])
        raise
    return done


def _closed(writer: SegmentWriter) -> Segment:
    digest = writer.close()
    runs: Runs = runs_of(writer.ids)
    return Segment(writer.path.name, writer.nbytes, digest, runs, runs)


def commit(folder: Path, manifest: Manifest, written: list[Segment]) -> None:
    """Make the manifest the map, then remove what it does not name. Raises OSError, the map being as before.

    Raises NotFlushed where it is the map, but may not be after a power cut: the files of both states stay.
    """
    try:
        write_manifest(folder, manifest)
    except NotFlushed:
        raise
    except OSError:
        _remove(folder, [NAME + ".new", *(s.file for s in written)])
        raise
    named = {NAME, _LOCK, *(s.file for s in manifest.segments)}
    with suppress(OSError):
        _remove(folder, [name for name in os.listdir(folder) if _OURS.fullmatch(name) and name not in named])


def _remove(folder: Path, names: Iterable[str]) -> None:
    for name in names:
        with suppress(OSError):
            os.unlink(folder / name)


def _next_generation(folder: Path) -> int:
    """A number above that of the map there which no file carries yet. Raises MapError when there is none left."""
    known = read_manifest(folder).generation if (folder / NAME).exists() else 0
    taken = {path.name[8:16] for path in segment_files(folder)}
    number = next(n for n in count(known + 1) if f"{n:08d}" not in taken)
    if number > LAST_GENERATION:
        raise MapError(f"{folder} was saved {known} times; allowed: {LAST_GENERATION}; save to another path")
    return number


def _kept_aside(folder: Path, manifest: Manifest) -> Path:
    """A folder beside that holds the same map: its files by second names, which costs no space. Raises OSError."""
    aside = next(p for n in count(1) if not (p := folder.with_name(f"{folder.name}.before-{n}")).exists())
    os.mkdir(aside)
    for name in (*(s.file for s in manifest.segments), NAME):  # the manifest last: until then it is no map
        os.link(folder / name, aside / name)
    sync_folder(aside)
    sync_folder(aside.parent)
    return aside


def segment_files(folder: Path) -> list[Path]:
    """Every segment file there, named by a manifest or not, oldest first."""
    return sorted(path for path in folder.glob("segment-*.pnv") if _OURS.fullmatch(path.name))


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder against other processes, making it if need be. Raises MapError."""
    try:
        os.makedirs(folder, exist_ok=True)
        strangers = [name for name in os.listdir(folder) if not _OURS.fullmatch(name)]
        if strangers:
            raise MapError(
                f"{folder} holds {strangers[0]!r}, which is no part of a map; allowed: a new or a map folder"
            )
        handle = os.open(folder / _LOCK, os.O_CREAT | os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        why = getattr(error, "strerror", None) or error
        raise MapError(f"cannot save {folder}: {why}; allowed: a writable folder") from error
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise MapError(f"{folder} is being saved by another process") from error
        except OSError as error:
            raise MapError(f"cannot lock {folder}: {error.strerror}; allowed: a file system with locks") from error
        yield
    finally:
        os.close(handle)

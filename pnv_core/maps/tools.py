"""What is done with maps at rest: verify, merge, prune, recover, export. Every result is a new map or file."""

import csv
import math
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from pnv_core.database.eviction import make_eviction
from pnv_core.database.keyframes import bytes_needed
from pnv_core.database.patch_codes import PatchCodes, views
from pnv_core.errors import ConfigError, MapError
from pnv_core.maps.manifest import NAME, Manifest, holds, read_manifest
from pnv_core.maps.reading import open_map
from pnv_core.maps.segment import Layouts, SavedKeyframe, SegmentHeader, salvage
from pnv_core.maps.store import commit, locked, segment_files, sessions_of, write_segments
from pnv_core.types import ImageRef


def verify(path: Path) -> Manifest:
    """Read and check every byte of a map. Raises MapError naming the file and what is wrong."""
    with open_map(path) as opened:
        for _ in opened.keyframes():
            pass
        return opened.manifest


def merge(first: Path, second: Path, output: Path) -> Manifest:
    """Both maps in one: the second's ids and sessions are counted on from the first's.

    Raises MapError for a damaged map, for maps of two models, or an output that exists.
    """
    with open_map(first) as one, open_map(second) as other:
        a, b = one.manifest, other.manifest
        if a.fingerprint != b.fingerprint:
            raise MapError(
                f"{first} is of model {a.fingerprint}, {second} of {b.fingerprint}; allowed: maps of one model"
            )

        def keyframes() -> Iterator[SavedKeyframe]:
            yield from one.keyframes()
            for kf in other.keyframes():
                ref = replace(kf.ref, id=kf.ref.id + a.next_id, session=kf.ref.session + a.next_session)
                yield replace(kf, ref=ref)

        return write_map(output, a, keyframes, a.next_id + b.next_id, a.next_session + b.next_session)


def prune(
    path: Path,
    output: Path,
    *,
    keep: int | None = None,
    budget_mb: float | None = None,
    drop_sessions: Iterable[int] = (),
    eviction: str = "densest",
) -> Manifest:
    """The map without some sessions, thinned by an eviction policy to `keep` keyframes or a `memory_budget_mb`.

    Raises MapError for a damaged map, a session that is not in it, or an output that exists; ConfigError for a
    number below zero or not finite.
    """
    for name, number in (("keep", keep), ("budget_mb", budget_mb)):
        if number is not None and not 0 <= number < math.inf:
            raise ConfigError(f"{name} = {number}; allowed: a number of at least 0")
    with open_map(path) as opened:
        manifest = opened.manifest
        dropped = set(drop_sessions)
        unknown = dropped - {s.session for s in manifest.sessions}
        if unknown:
            allowed = ", ".join(str(s.session) for s in manifest.sessions)
            raise MapError(f"session {min(unknown)} is not in {path}; allowed: {allowed}")
        policy = make_eviction(eviction)
        refs, sizes = {}, {}
        for kf in opened.keyframes():
            if kf.ref.session not in dropped:
                refs[kf.ref.id], sizes[kf.ref.id] = kf.ref, len(kf.buffer)
                policy.added(kf.ref, np.array(kf.vector))
        patches = sum(sizes.values())
        most = len(refs) if keep is None else keep
        budget = math.inf if budget_mb is None else budget_mb * 1e6
        while refs and (len(refs) > most or bytes_needed(manifest.dim, len(refs), patches) > budget):
            gone = policy.choose()
            policy.removed(refs.pop(gone))
            patches -= sizes[gone]

        def keyframes() -> Iterator[SavedKeyframe]:
            return (kf for kf in opened.keyframes() if kf.ref.id in refs)

        return write_map(output, manifest, keyframes, manifest.next_id, manifest.next_session)


@dataclass(frozen=True)
class Recovery:
    """What was saved of a damaged map."""

    keyframes: int
    lost: int | None  # None where the manifest is lost as well
    problems: tuple[str, ...]


def recover(path: Path, output: Path) -> Recovery:
    """Write every keyframe of a damaged map that is whole to a new one.

    With a readable manifest exactly the keyframes it names are looked for; without, all that any segment holds, a
    newer segment's before an older one's. Raises MapError when nothing is left or the output exists.
    """
    problems: list[str] = []
    manifest: Manifest | None = None
    try:
        manifest = read_manifest(path)
        files = [path / s.file for s in manifest.segments]
    except MapError as error:
        problems.append(str(error))
        files = segment_files(path) if path.is_dir() else []
    found = _salvage_all(files, manifest, problems)
    if not found.keyframes or found.header is None:
        raise MapError(f"{path}: no whole keyframe found; nothing to recover")
    ids = sorted(found.keyframes)
    next_session = 1 + max(session for _, session in found.keyframes.values())
    base = manifest or Manifest(found.header.fingerprint, found.header.dim, 0, ids[-1] + 1, next_session, 0, (), (), ())

    def keyframes() -> Iterator[SavedKeyframe]:
        for file, run in groupby(ids, lambda i: found.keyframes[i][0]):  # ids of segments do not interleave
            wanted = dict.fromkeys(run)
            whole = {kf.ref.id: kf for kf in salvage(file)[1] if kf.ref.id in wanted}
            yield from (whole[i] for i in wanted)

    write_map(output, base, keyframes, base.next_id, max(base.next_session, next_session))
    return Recovery(len(ids), manifest.keyframes - len(ids) if manifest else None, tuple(problems))


@dataclass
class _Found:
    header: SegmentHeader | None
    keyframes: dict[int, tuple[Path, int]]  # id -> file that holds it, session


def _salvage_all(files: list[Path], manifest: Manifest | None, problems: list[str]) -> _Found:
    found = _Found(None, {})
    live = {s.file: s.live for s in manifest.segments} if manifest else None
    for file in reversed(files):  # newest first
        try:
            header, keyframes = salvage(file)
        except OSError as error:
            problems.append(f"{file}: {error.strerror}")
            continue
        if header is None:
            problems.append(f"{file}: both headers are damaged")
            continue
        if found.header is not None and (header.fingerprint, header.dim) != (
            found.header.fingerprint,
            found.header.dim,
        ):
            problems.append(f"{file}: of another model ({header.fingerprint})")
            continue
        found.header = found.header or header
        for kf in keyframes:
            if live is None or holds(live[file.name], kf.ref.id):
                found.keyframes.setdefault(kf.ref.id, (file, kf.ref.session))
    return found


def write_map(
    output: Path,
    like: Manifest,
    keyframes: Callable[[], Iterable[SavedKeyframe]],
    next_id: int,
    next_session: int,
) -> Manifest:
    """A new map of these keyframes; `keyframes` is read twice. Raises MapError."""
    if (output / NAME).exists():
        raise MapError(f"{output} holds a map already; allowed: a new folder")
    cameras: dict[str, None] = {}
    layouts: dict[Layouts, None] = {}
    refs: list[ImageRef] = []
    for kf in keyframes():
        cameras[kf.ref.camera] = layouts[kf.layouts] = None
        refs.append(kf.ref)
    header = SegmentHeader(like.fingerprint, like.dim, tuple(cameras), tuple(layouts))
    with locked(output):
        try:
            written = write_segments(output, 1, header, keyframes())
            manifest = Manifest(
                like.fingerprint,
                like.dim,
                1,
                next_id,
                next_session,
                len(refs),
                tuple(cameras),
                sessions_of(refs),
                tuple(written),
            )
            commit(output, manifest, written)
        except OSError as error:
            raise MapError(f"cannot write {output}: {error.strerror}") from error
    return manifest


def export_csv(path: Path, output: Path) -> int:
    """One row per keyframe: id, session, camera, stamp. Gives the number of rows. Raises MapError."""
    with open_map(path) as opened:

        def write(aside: Path) -> None:
            with open(aside, "w", newline="") as file:
                rows = csv.writer(file)
                rows.writerow(["id", "session", "camera", "stamp_ns", "stamp", "texture"])
                for kf in opened.keyframes():
                    ref = kf.ref
                    seconds, nanoseconds = divmod(ref.stamp_ns, 10**9)
                    stamp = f"{seconds}.{nanoseconds:09d}"
                    rows.writerow([ref.id, ref.session, ref.camera, ref.stamp_ns, stamp, f"{kf.texture:.6g}"])

        _write_aside(output, write)
        return opened.manifest.keyframes


def export_npz(path: Path, output: Path, *, patches: bool = False) -> int:
    """Arrays over N keyframes: ids, stamps_ns, sessions, cameras, textures, global (N, D); with `patches` also
    patches_<size> (N, P, D) float32 and grid_<size> = [rows, cols]. Gives N.

    Raises MapError, also where patch grids differ between keyframes.
    """
    columns: dict[str, list[Any]] = {
        key: [] for key in ("ids", "stamps_ns", "sessions", "cameras", "textures", "global")
    }
    grids: dict[str, list[Any]] = {}
    with open_map(path) as opened:
        for kf in opened.keyframes():
            ref = kf.ref
            row = (ref.id, ref.stamp_ns, ref.session, ref.camera, kf.texture, kf.vector)
            for column, value in zip(columns.values(), row, strict=True):
                column.append(value)
            for codes in views(kf.buffer, kf.layouts) if patches else ():
                _append_grid(path, grids, codes)
    arrays = {key: np.array(values) for key, values in (columns | grids).items()}
    for key in [key for key in arrays if key.startswith("grid_")]:
        arrays[key] = arrays[key][0]

    def write(aside: Path) -> None:
        with open(aside, "wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]

    _write_aside(output, write)
    return len(columns["ids"])


def _append_grid(path: Path, grids: dict[str, list[Any]], codes: PatchCodes) -> None:
    patches = grids.setdefault(f"patches_{codes.size}", [])
    shapes = grids.setdefault(f"grid_{codes.size}", [])
    if shapes and shapes[0] != (codes.rows, codes.cols):
        given = f"{codes.rows} x {codes.cols}"
        raise MapError(f"{path}: patch grids of size {codes.size} differ ({given} and {shapes[0][0]} x {shapes[0][1]})")
    patches.append(codes.decode())
    shapes.append((codes.rows, codes.cols))


def _write_aside(output: Path, write: Callable[[Path], None]) -> None:
    aside = output.with_name(output.name + ".part")
    with ExitStack() as undo:
        undo.callback(aside.unlink, missing_ok=True)
        try:
            write(aside)
            with open(aside, "rb") as file:
                os.fsync(file.fileno())
            os.replace(aside, output)
        except OSError as error:
            raise MapError(f"cannot write {output}: {error.strerror}") from error

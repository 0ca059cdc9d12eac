"""The manifest of a saved map, `map.json`: what the map consists of. Replacing it is what makes a save take effect.

Nothing in it is believed: the checksum finds damage, not malice. Every number is bounded, every name is one that a save
writes, and what is said twice must agree, before anything is opened or allocated by it.
"""

import hashlib
import json
import os
from bisect import bisect_right
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from pnv_core.errors import MapError, shown
from pnv_core.files import open_regular, sync_folder

NAME = "map.json"
FORMAT, VERSION = "pnv_map", 1
LAST_GENERATION = 99_999_999  # eight digits in a segment's name
LEAST_RECORD = 52  # bytes of a keyframe in a segment beside its vector and patches
_MOST_BYTES = 256_000_000  # of a manifest; a million keyframes thinned to every other one take 15 MB
SEGMENT_NAME = r"segment-(\d{8})-\d{4}\.pnv"

_Count = Annotated[int, msgspec.Meta(ge=0, lt=2**53)]  # ids travel as float64
_Session = Annotated[int, msgspec.Meta(ge=0, lt=2**31 - 1)]
_Stamp = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]
_Name = Annotated[str, msgspec.Meta(max_length=1000)]
Runs = tuple[tuple[_Count, _Count], ...]  # (first, last) of runs of consecutive ids


def runs_of(ids: list[int]) -> Runs:
    """Ascending ids as runs."""
    if not ids:
        return ()
    values = np.asarray(ids, np.int64)
    breaks = np.flatnonzero(np.diff(values) != 1)
    firsts, lasts = values[np.r_[0, breaks + 1]], values[np.r_[breaks, len(values) - 1]]
    return tuple(zip(firsts.tolist(), lasts.tolist(), strict=True))


def ids_of(runs: Runs) -> list[int]:
    return [i for first, last in runs for i in range(first, last + 1)]


def count_of(runs: Runs) -> int:
    return sum(last - first + 1 for first, last in runs)


def holds(runs: Runs, number: int) -> bool:
    """Whether an id lies in ascending runs."""
    place = bisect_right(runs, (number, 2**63)) - 1
    return place >= 0 and number <= runs[place][1]


@dataclass(frozen=True)
class Segment:
    """A file of keyframes: all ids in it, and those of them that still belong to the map."""

    file: Annotated[str, msgspec.Meta(pattern=rf"\A{SEGMENT_NAME}\Z")]
    bytes: _Count
    digest: Annotated[int, msgspec.Meta(ge=0, lt=2**32)]
    ids: Runs
    live: Runs


@dataclass(frozen=True)
class Session:
    """One run of the robot."""

    session: _Session
    keyframes: Annotated[int, msgspec.Meta(ge=1, lt=2**53)]
    first_stamp_ns: _Stamp
    last_stamp_ns: _Stamp


@dataclass(frozen=True)
class Manifest:
    """One complete state of a map."""

    fingerprint: Annotated[str, msgspec.Meta(max_length=200)]
    dim: Annotated[int, msgspec.Meta(ge=1, le=1_000_000)]
    generation: Annotated[int, msgspec.Meta(ge=0, le=LAST_GENERATION)]  # counts saves
    next_id: _Count
    next_session: _Session
    keyframes: _Count
    cameras: tuple[_Name, ...]
    sessions: tuple[Session, ...]
    segments: tuple[Segment, ...]

    def encode(self) -> bytes:
        body = {"format": FORMAT, "version": VERSION} | asdict(self)
        return json.dumps(body | {"sha256": _digest(body)}, indent=1).encode()


def _digest(body: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()


def read_manifest(folder: Path) -> Manifest:
    """Raises MapError naming the file and what is wrong with it."""
    path = folder / NAME
    try:
        with open_regular(path) as file:
            text = file.read(_MOST_BYTES + 1)
    except NotADirectoryError as error:
        raise MapError(f"{folder} is not a map; allowed: a folder written by a save") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        why = getattr(error, "strerror", None) or error
        raise MapError(f"{path}: {why}; allowed: a saved map (a folder with {NAME})") from error
    if len(text) > _MOST_BYTES:
        raise _damaged(path, f"more than {_MOST_BYTES} bytes")
    try:
        body = json.loads(text)
        checksum = body.pop("sha256")
        if body["format"] != FORMAT:
            raise MapError(f"{path}: format {shown(body['format'])}; allowed: {FORMAT!r}")
        if body["version"] != VERSION:
            raise MapError(f"{path}: format version {shown(body['version'])}; allowed: {VERSION}")
        whole = checksum == _digest(body)
    except MapError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise _damaged(path, error) from error
    if not whole:
        raise _damaged(path, "checksum wrong")
    try:
        manifest = msgspec.convert({k: v for k, v in body.items() if k not in ("format", "version")}, Manifest)
    except (msgspec.ValidationError, RecursionError) as error:
        raise _damaged(path, error) from error
    if wrong := _contradiction(manifest):
        raise _damaged(path, wrong)
    return manifest


def _damaged(path: Path, why: object) -> MapError:
    return MapError(f"{path} is damaged: {why}; `pnv map recover` saves what is whole")


def _contradiction(manifest: Manifest) -> str:
    """What no save writes, in words; empty where all agrees."""
    runs = [run for s in manifest.segments for run in s.ids]
    sessions = [s.session for s in manifest.sessions]
    for s in manifest.segments:
        if int(s.file[8:16]) > manifest.generation:
            return f"{s.file} is newer than save {manifest.generation}"
        if not s.ids or not _ascending(s.live) or not all(_within(run, s.ids) for run in s.live):
            return f"{s.file} lists ids that it does not hold"
        if count_of(s.ids) * (LEAST_RECORD + 4 * manifest.dim) > s.bytes:
            return f"{s.file} of {s.bytes} bytes lists {count_of(s.ids)} keyframes"
    if not _ascending(tuple(runs)) or (runs and runs[-1][1] >= manifest.next_id):
        return f"ids do not ascend to {manifest.next_id}"
    if len({s.file for s in manifest.segments}) != len(manifest.segments):
        return "a segment is named twice"
    if sum(count_of(s.live) for s in manifest.segments) != manifest.keyframes:
        return f"its segments do not hold {manifest.keyframes} keyframes"
    if sum(s.keyframes for s in manifest.sessions) != manifest.keyframes:
        return f"its sessions do not hold {manifest.keyframes} keyframes"
    if any(a >= b for a, b in pairwise([*sessions, manifest.next_session])):
        return f"sessions do not ascend to {manifest.next_session}"
    if any(s.first_stamp_ns > s.last_stamp_ns for s in manifest.sessions):
        return "a session ends before it begins"
    if len(set(manifest.cameras)) != len(manifest.cameras):
        return "a camera is named twice"
    return ""


def _ascending(runs: Runs) -> bool:
    return all(first <= last for first, last in runs) and all(a[1] < b[0] for a, b in pairwise(runs))


def _within(run: tuple[int, int], runs: Runs) -> bool:
    place = bisect_right(runs, (run[0], 2**63)) - 1
    return place >= 0 and runs[place][0] <= run[0] and run[1] <= runs[place][1]


class NotFlushed(OSError):
    """The manifest was replaced; whether that outlasts a power cut is not known."""


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Replace the manifest at once. Raises OSError, the one before then being untouched.

    Raises NotFlushed where the new one is in place, but the folder could not be flushed: after a power cut it may be
    either of the two.
    """
    aside = folder / (NAME + ".new")
    with open(aside, "wb") as file:
        file.write(manifest.encode())
        file.flush()
        os.fsync(file.fileno())
    sync_folder(folder)  # the segments' names first
    os.replace(aside, folder / NAME)
    try:
        sync_folder(folder)
    except OSError as error:
        raise NotFlushed(error.errno, error.strerror) from error

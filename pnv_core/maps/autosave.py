"""Autosave: a thread that saves a map every so often while frames go on."""

import threading
from collections.abc import Callable

from pnv_core.database import KeyframeDatabase
from pnv_core.errors import MapError
from pnv_core.maps.store import MapStore, SaveReport


class Autosave:
    """Saves the database into the store every `interval_s` seconds, and once more on `stop`.

    A save that fails is reported and tried again at the next turn; recognition never sees it.
    """

    def __init__(
        self,
        database: KeyframeDatabase,
        store: MapStore,
        interval_s: float,
        report: Callable[[SaveReport | MapError], None],
    ) -> None:
        self._database = database
        self._store = store
        self._interval_s = interval_s
        self._report = report
        self._stop = threading.Event()
        self._saving = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="autosave", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def save_now(self) -> SaveReport:
        """Save in the calling thread, after a save in progress. Raises MapError."""
        with self._saving:
            return self._store.save(self._database.snapshot())

    def stop(self) -> None:
        """End the thread and save what is left."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self._save()

    def _run(self) -> None:
        while not self._stop.wait(self._interval_s):
            self._save()

    def _save(self) -> None:
        try:
            self._report(self.save_now())
        except MapError as error:
            self._report(error)
        except Exception as error:  # a defect: say so before the thread ends, rather than never save again in silence
            self._report(MapError(f"autosave has ended: {error!r}"))
            raise

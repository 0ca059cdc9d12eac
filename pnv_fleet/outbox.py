"""The outbox: keyframes on this robot's disk until the store has acknowledged them."""

import fcntl
import os
import sqlite3
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from pnv_fleet.errors import FleetError
from pnv_fleet.places import Place, from_bytes, to_bytes

_VERSION = 1


@dataclass(frozen=True, eq=False)
class Waiting:
    """A keyframe in the outbox. `asked`: the fleet has answered the query it made; `predecessor` as in Query."""

    number: int
    place: Place
    predecessor: float
    asked: bool


class Outbox:
    """A file of keyframes within `limit_mb`; when full, the oldest goes and is counted. Safe from any thread.

    SQLite in WAL mode: what `add` returned from outlasts kill -9 (a power cut may take the last moments). One process
    at a time. Raises FleetError: a file that is no outbox, damaged, held by another process, a full disk.
    """

    def __init__(self, path: Path | str, limit_mb: float) -> None:
        self.path = Path(path)
        self.dropped = 0
        self._limit = int(limit_mb * 1e6)
        self._using = threading.Lock()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._held = os.open(self.path.with_name(self.path.name + ".lock"), os.O_CREAT | os.O_RDWR, 0o600)
        except OSError as error:
            raise FleetError(f"outbox {self.path}: {error.strerror}; allowed: a writable folder") from None
        try:
            fcntl.flock(self._held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._held)
            raise FleetError(
                f"outbox {self.path} is held by another process; allowed: one node per fleet_robot and fleet_outbox"
            ) from None
        try:
            with self._told():
                self._open()
        except FleetError:
            os.close(self._held)
            raise

    def _open(self) -> None:
        self._file = sqlite3.connect(self.path, timeout=5.0, check_same_thread=False, isolation_level=None)
        self._file.execute("PRAGMA journal_mode=WAL")
        self._file.execute("PRAGMA synchronous=NORMAL")
        (version,) = self._file.execute("PRAGMA user_version").fetchone()
        if version not in (0, _VERSION):
            raise FleetError(f"outbox {self.path} is of version {version}; allowed: {_VERSION}")
        self._file.execute(
            "CREATE TABLE IF NOT EXISTS places (number INTEGER PRIMARY KEY AUTOINCREMENT, key TEXT NOT NULL UNIQUE, "
            "predecessor REAL NOT NULL, asked INTEGER NOT NULL, bytes INTEGER NOT NULL, place BLOB NOT NULL)"
        )
        self._file.execute(f"PRAGMA user_version={_VERSION}")
        self._count, self._bytes = self._file.execute("SELECT COUNT(*), COALESCE(SUM(bytes), 0) FROM places").fetchone()

    @contextmanager
    def _told(self) -> Iterator[None]:
        """SQLite's errors as a sentence."""
        with self._using:
            try:
                yield
            except sqlite3.Error as error:
                raise FleetError(f"outbox {self.path}: {error}; allowed: an intact file on a disk with room") from None

    def __len__(self) -> int:
        return self._count

    @property
    def nbytes(self) -> int:
        """Bytes of the keyframes that wait."""
        return self._bytes

    def add(self, place: Place, predecessor: float) -> None:
        """Keep a keyframe; one that waits already is left as it is."""
        data = to_bytes(place)
        if len(data) > self._limit:
            raise FleetError(f"a keyframe of {len(data)} bytes; allowed by fleet_outbox_mb: {self._limit}")
        with self._told():
            over = self._bytes + len(data) - self._limit
            oldest = self._oldest_of(over) if over > 0 else []
            self._file.execute("BEGIN")
            try:
                self._file.executemany("DELETE FROM places WHERE number = ?", [(n,) for n, _ in oldest])
                done = self._file.execute(
                    "INSERT OR IGNORE INTO places (key, predecessor, asked, bytes, place) VALUES (?, ?, 0, ?, ?)",
                    (place.key, predecessor, len(data), data),
                )
                self._file.execute("COMMIT")
            except BaseException:
                if self._file.in_transaction:
                    self._file.execute("ROLLBACK")
                raise
            self.dropped += len(oldest)
            self._count += done.rowcount - len(oldest)
            self._bytes += done.rowcount * len(data) - sum(size for _, size in oldest)

    def _oldest_of(self, nbytes: int) -> list[tuple[int, int]]:
        found: list[tuple[int, int]] = []
        for number, size in self._file.execute("SELECT number, bytes FROM places ORDER BY number"):
            if nbytes <= 0:
                break
            found.append((number, size))
            nbytes -= size
        return found

    def oldest(self, most: int, most_bytes: int, but: Iterable[str] = ()) -> list[Waiting]:
        """The keyframes that wait longest, without those of the keys `but`; at least one where there is any.

        A damaged one is dropped and counted.
        """
        passed, total = set(but), 0
        found: list[Waiting] = []
        damaged: list[int] = []
        with self._told():
            rows = self._file.execute("SELECT number, key, predecessor, asked, place FROM places ORDER BY number")
            for number, key, predecessor, asked, data in rows:
                if key in passed:
                    continue
                if found and (len(found) >= most or total + len(data) > most_bytes):
                    break
                try:
                    found.append(Waiting(number, from_bytes(data), predecessor, bool(asked)))
                    total += len(data)
                except FleetError:
                    damaged.append(number)
            rows.close()
        if damaged:
            self.remove(damaged)
            self.dropped += len(damaged)
        return found

    def answered(self, key: str) -> None:
        """The fleet has answered this keyframe's query."""
        with self._told():
            self._file.execute("UPDATE places SET asked = 1 WHERE key = ?", (key,))

    def unanswered(self, key: str) -> bool:
        """Whether a keyframe waits here whose query was not answered."""
        with self._told():
            row = self._file.execute("SELECT asked FROM places WHERE key = ?", (key,)).fetchone()
        return row is not None and not row[0]

    def drop(self, key: str) -> None:
        """Forget a keyframe that need not be sent."""
        with self._told():
            rows = self._file.execute("SELECT number FROM places WHERE key = ?", (key,)).fetchall()
        self.remove([number for (number,) in rows])

    def remove(self, numbers: Sequence[int]) -> None:
        """Forget keyframes that the store has acknowledged."""
        if not numbers:
            return
        marks = ",".join("?" * len(numbers))
        with self._told():
            gone = self._file.execute(
                f"DELETE FROM places WHERE number IN ({marks}) RETURNING bytes", list(numbers)
            ).fetchall()
        self._count -= len(gone)
        self._bytes -= sum(size for (size,) in gone)

    def close(self) -> None:
        with self._using:
            self._file.close()
            os.close(self._held)

"""Fleet: a robot's part in the fleet's memory. Recognition hands keyframes over and never waits."""

import math
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from pnv_core.config import Config
from pnv_core.types import ImageRef, LoopClosure, PlaceDescriptor, Query
from pnv_fleet.answers import Answers, of_robot
from pnv_fleet.errors import FleetError
from pnv_fleet.outbox import Outbox, Waiting
from pnv_fleet.places import (
    Place,
    descriptor_of,
    encode_view,
    layouts_of,
    parts_of,
    robot_name,
    row_bytes,
    without_picture,
)
from pnv_fleet.store import Access, PlaceStore, check_uri

_LANES = ("ask", "send")  # who speaks to the store
_MOST_OFFERED = 64  # keyframes in memory that the outbox has not taken yet
_BATCH, _BATCH_BYTES = 16, 2_000_000
_LONGEST_PAUSE_S = 30.0  # between tries of a store that fails
_NICE = 10  # the fleet's threads give way to recognition
_IDLE_S = 0.2
_COUNTED = ("sent", "covered", "expired", "asked", "late", "closures", "refused", "bytes_sent", "bytes_received")
_EXPIRY_S = 3600.0  # between two looks for places that are too old
_CLOSE_S = 1.0
_TIMEOUT_S = 5.0  # of one call to the store


@dataclass(frozen=True)
class Options:
    """A robot's part: see the settings `fleet_...` of the node."""

    uri: str
    robot: str
    budget_ms: float
    outbox: Path
    outbox_mb: float
    kb_s: float
    coverage: float
    pictures: bool
    keep_days: float = 0.0  # 0: for ever


@dataclass(frozen=True)
class FleetStatus:
    """What happened so far, and what is wrong since when (epoch seconds; empty where nothing is)."""

    problem: str
    since: float
    waiting: int  # keyframes in the outbox
    dropped: int  # keyframes given up, sent or not asked for
    robots: dict[str, int]  # closures by the robot they are with
    sent: int = 0
    covered: int = 0  # keyframes not sent, since the fleet has their place
    expired: int = 0  # places of this robot that were forgotten for their age
    asked: int = 0
    late: int = 0  # answers after the budget
    closures: int = 0
    refused: int = 0  # rows that were not believed
    bytes_sent: int = 0
    bytes_received: int = 0

    def sentence(self) -> str:
        """For people; empty where nothing is wrong."""
        if not self.problem:
            return ""
        then = datetime.fromtimestamp(self.since, timezone.utc).strftime("%H:%M:%S UTC")
        return f"fleet: {self.problem}, since {then}; {self.waiting} keyframes wait"

    def values(self) -> dict[str, str]:
        """By name, as /diagnostics shows them."""
        return {
            "fleet": self.sentence() or "no failure",
            "fleet: keyframes sent": str(self.sent),
            "fleet: keyframes waiting": str(self.waiting),
            "fleet: keyframes dropped": str(self.dropped),
            "fleet: keyframes covered": str(self.covered),
            "fleet: places expired": str(self.expired),
            "fleet: queries": str(self.asked),
            "fleet: late answers": str(self.late),
            "fleet: rows refused": str(self.refused),
            "fleet: closures": str(self.closures),
            "fleet: closures by robot": ", ".join(f"{r} {n}" for r, n in sorted(self.robots.items())) or "none",
            "fleet: sent [kB]": f"{self.bytes_sent / 1e3:.0f}",
            "fleet: received [kB]": f"{self.bytes_received / 1e3:.0f}",
        }


@dataclass(frozen=True, eq=False)
class _Asked:
    """A query on its way: the place it becomes, how it is asked, when it was handed over."""

    query: Query
    place: Place | None  # None for a query that is not shared
    where: str
    offered: float


class Fleet:
    """Threads that keep, ask and send. `closures` is called with the candidates of a query, `say` with log lines.

    keep   keyframes handed over become places in the outbox
    ask    the fleet is asked for each, in order; what has waited longer than the budget is left to send
    send   places go to the store in batches; queries that were not answered in time are asked first

    Raises FleetError for an address, a name or an outbox that cannot be used.
    """

    def __init__(
        self,
        options: Options,
        config: Config,
        fingerprint: str,
        like: PlaceDescriptor,
        calibration: dict | None,
        closures: Callable[[list[LoopClosure]], None],
        say: Callable[[str], None],
    ) -> None:
        self.options = options
        check_uri(options.uri)
        self._robot = robot_name(options.robot)
        self._access = Access.from_environment()
        self._fingerprint, self._config = fingerprint, config
        self._like, self._parts = like, parts_of(layouts_of(like))
        self._lanes = {lane: Answers(config, calibration, like) for lane in _LANES}
        self._closures, self._say = closures, say
        self._outbox = Outbox(options.outbox, options.outbox_mb)
        self._stores: dict[str, PlaceStore] = {}  # each lane its own: what one closes the other may use
        self._sessions: dict[int, int] = {}
        self._offered: deque[tuple[Query, int, tuple[float, float, float] | None, float]] = deque()
        self._fresh: deque[_Asked] = deque()
        self._pending: set[str] = set()  # keys that `ask` will deal with
        self._changed = threading.Condition()
        self._connecting = threading.Lock()
        self._ended = threading.Event()
        self._troubles: dict[str, tuple[str, float]] = {}  # of the outbox and the lanes: what, since when
        self._pause_s, self._again = dict.fromkeys(_LANES, 0.0), dict.fromkeys(_LANES, 0.0)
        self._told = ""  # what the store is
        self._counts: Counter[str] = Counter()
        self._robots: Counter[str] = Counter()
        self._owed = 0.0  # bytes beyond the limit
        self._newest_ns, self._expiry_due = 0, 0.0
        self._threads = [
            threading.Thread(target=self._guarded(run), name=f"fleet {name}", daemon=True)
            for name, run in (("keep", self._keep), ("ask", self._ask), ("send", self._send))
        ]
        for thread in self._threads:
            thread.start()

    # What recognition calls; none of these waits

    def offer(self, query: Query, oldest_ns: int, position: tuple[float, float, float] | None = None) -> None:
        """A keyframe was made (or, with id -1, a query that is none).

        `oldest_ns` is the stamp of the oldest keyframe that is known locally: younger ones of this robot are not asked
        for. `position` is where it was taken, in metres, if that is known.
        """
        with self._changed:
            self._offered.append((query, oldest_ns, position, time.monotonic()))
            if len(self._offered) > _MOST_OFFERED:
                self._offered.popleft()
                self._counts["lost"] += 1
            self._changed.notify_all()

    def change(self, config: Config) -> None:
        """Other live settings of the recogniser."""
        self._config = config

    def sessions(self, refs: Iterable[ImageRef]) -> None:
        """A map was loaded: these keyframes are its sessions'."""
        first: dict[int, int] = {}
        for ref in refs:
            first[ref.session] = min(ref.stamp_ns, first.get(ref.session, ref.stamp_ns))
        self._sessions = first

    def status(self) -> FleetStatus:
        with self._changed:
            troubles, counts, robots = dict(self._troubles), Counter(self._counts), dict(self._robots)
        return FleetStatus(
            problem="; ".join(dict.fromkeys(text for text, _ in troubles.values())),
            since=min((since for _, since in troubles.values()), default=0.0),
            waiting=len(self._outbox),
            dropped=counts["lost"] + self._outbox.dropped,
            robots=robots,
            **{name: counts[name] for name in _COUNTED},
        )

    def close(self) -> None:
        """End the threads; what is not sent yet stays in the outbox."""
        self._ended.set()
        with self._changed:
            self._changed.notify_all()
        for thread in self._threads:  # one that waits for a silent store is left behind
            thread.join(timeout=_CLOSE_S)
        for lane in _LANES:
            self._disconnect(lane)
        self._outbox.close()

    # keep

    def _keep(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._offered or self._ended.is_set())
                if not self._offered:
                    return
                item = self._offered.popleft()
            self._take(*item)

    def _take(self, query: Query, oldest_ns: int, position: tuple[float, float, float] | None, offered: float) -> None:
        ref = query.ref
        self._newest_ns = max(self._newest_ns, ref.stamp_ns)
        session = self._sessions.setdefault(ref.session, ref.stamp_ns)
        seen = without_picture(query.descriptor)
        shared = None
        if ref.id >= 0:
            kept = query.descriptor if self.options.pictures else seen
            shared = Place(
                self._robot, session, ref.camera, ref.id, ref.stamp_ns, seen.texture, seen.global_vector,
                encode_view(kept), position,
            )  # fmt: skip
            with self._changed:
                self._pending.add(shared.key)  # before `send` can see it
            try:
                self._outbox.add(shared, query.predecessor)
                self._well("outbox")
            except FleetError as error:
                self._tally(lost=1)
                self._trouble("outbox", str(error))
                with self._changed:
                    self._pending.discard(shared.key)
                shared = None
        asked = Query(ref, seen, query.predecessor)
        with self._changed:
            self._fresh.append(
                _Asked(of_robot(asked, self._robot, session), shared, self._where(ref.stamp_ns, oldest_ns), offered)
            )
            self._changed.notify_all()

    def _where(self, stamp_ns: int, oldest_ns: int) -> str:
        """Every place but this robot's own that are known locally or recent."""
        recent = stamp_ns - int(self._config.exclude_recent_s * 1e9)
        return f'robot != "{self._robot}" or stamp_ns < {max(0, min(oldest_ns, recent))}'

    # ask

    def _ask(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._fresh or self._ended.is_set())
                if self._ended.is_set():
                    return
                asked = self._fresh.popleft()
            try:
                in_time = (time.monotonic() - asked.offered) * 1e3 <= self.options.budget_ms
                if in_time and self._owed <= 0:
                    self._answer("ask", asked)
                else:  # left to `send`: what follows it does not follow what was asked before it
                    self._lanes["ask"].forget()
            except FleetError as error:
                self._fail("ask", str(error))
            finally:
                with self._changed:
                    if asked.place is not None:
                        self._pending.discard(asked.place.key)
                    self._changed.notify_all()

    def _answer(self, lane: str, asked: _Asked) -> bool:
        """Ask and hand the answer on; False where the store is not to be tried yet. Raises FleetError."""
        store, answers = self._connected(lane), self._lanes[lane]
        if store is None:
            return False
        answers.config = self._config
        before = answers.received
        found = answers.to(asked.query, store, asked.where)
        accepted = [c for c in found if c.accepted]
        late = (time.monotonic() - asked.offered) * 1e3 > self.options.budget_ms
        more, refused = answers.received - before, len(answers.refused)
        self._tally(asked=1, late=late, closures=len(accepted), refused=refused, bytes_received=more)
        self._owe(more)
        self._well("ask")
        self._robots.update(c.match.robot for c in accepted)
        for told in answers.refused:
            self._say(f"refused {told}")
        answers.refused.clear()
        if found:
            self._closures(found)
        if asked.place is not None:
            if self.options.coverage < 1.0 and any(c.similarity >= self.options.coverage for c in accepted):
                self._tally(covered=1)
                self._outbox.drop(asked.place.key)
            else:
                self._outbox.answered(asked.place.key)
        return True

    # send

    def _send(self) -> None:
        while not self._ended.is_set():
            try:
                busy = self._send_some()
                self._expire()
            except FleetError as error:
                self._fail("send", str(error))
                busy = False
            if not busy:
                with self._changed:
                    self._changed.wait_for(self._ended.is_set, timeout=_IDLE_S)

    def _send_some(self) -> bool:
        """Whether there was something to send and it went."""
        self._repay()
        with self._changed:
            pending = set(self._pending)
        limit = _BATCH_BYTES if not self.options.kb_s else min(_BATCH_BYTES, int(self.options.kb_s * 1e3))
        batch = self._outbox.oldest(_BATCH, limit, pending)
        if not batch:
            return False
        store = self._connected("send")
        kept = self._answered(batch) if store is not None else None
        if store is None or kept is None:
            return False
        if kept:
            store.put([w.place for w in kept])
            self._outbox.remove([w.number for w in kept])
            count = sum(row_bytes(w.place) for w in kept)
            self._tally(sent=len(kept), bytes_sent=count)
            self._owe(count)
        self._well("send")
        return True

    def _answered(self, batch: list[Waiting]) -> list[Waiting] | None:
        """Those to send, once the fleet was asked what it was not asked in time; None where it cannot be."""
        late = [w for w in batch if not w.asked]
        for w in late:
            with self._changed:
                pending = w.place.key in self._pending
            if pending or not self._outbox.unanswered(w.place.key):  # `ask` marks it before it lets go of it
                continue
            place = w.place
            try:
                seen = descriptor_of(place, self._like)
            except FleetError as error:  # of another release: it would never go
                self._say(f"fleet: dropped keyframe {place.keyframe} of the outbox: {error}")
                self._tally(lost=1)
                self._outbox.drop(place.key)
                continue
            query = Query(place.ref, seen, w.predecessor)
            asked = _Asked(query, place, self._where(place.stamp_ns, place.session), -math.inf)
            self._repay()
            if self._ended.is_set() or not self._answer("send", asked):
                return None
        if not late:
            return batch
        with self._changed:
            pending_keys = set(self._pending)
        now = {w.number: w for w in self._outbox.oldest(len(batch), 2 * _BATCH_BYTES, pending_keys)}
        return [now[w.number] for w in batch if w.number in now and now[w.number].asked]

    def _expire(self) -> None:
        """Now and then, forget this robot's places of long ago. Age is counted in its own stamps, as in a replay."""
        if not self.options.keep_days or not self._newest_ns or time.monotonic() < self._expiry_due:
            return
        store = self._connected("send")
        if store is None:
            return
        oldest_ns = self._newest_ns - int(self.options.keep_days * 86_400e9)
        count = store.forget(f'robot == "{self._robot}" and stamp_ns < {oldest_ns}') if oldest_ns > 0 else 0
        self._expiry_due = time.monotonic() + _EXPIRY_S
        self._tally(expired=count)
        if count:
            self._say(f"fleet: forgot {count} places older than {self.options.keep_days:g} days")

    def _repay(self) -> None:
        """Wait until the limit allows to send and to ask again."""
        while self._owed > 0 and not self._ended.is_set():
            wait = min(0.5, self._owed / (self.options.kb_s * 1e3))
            self._ended.wait(wait)
            self._owe(-wait * self.options.kb_s * 1e3)

    def _owe(self, count: float) -> None:
        """Bytes beyond the limit, from either lane."""
        with self._changed:
            self._owed += count if self.options.kb_s else 0.0

    # The store's state

    def _connected(self, lane: str) -> PlaceStore | None:
        """The lane's store; None while the lane leaves it alone after a failure. Raises FleetError."""
        if time.monotonic() < self._again[lane]:
            return None
        store = self._stores.get(lane)
        if store is None:
            with self._connecting:  # one after the other: the first may have to make the collection
                store = self._stores[lane] = self._opened()
        return store

    def _opened(self) -> PlaceStore:
        timeout_s = max(_TIMEOUT_S, 4e-3 * self.options.budget_ms)
        dim = len(self._like.global_vector)
        store = PlaceStore(self.options.uri, self._fingerprint, self._access, dim, self._parts, timeout_s)
        told = f"fleet: {self.options.uri} ({store.version()}), collection {store.collection}"
        if store.others:
            told += f"; {len(store.others)} other models, which cannot be compared"
        if told != self._told:
            self._say(told)
        self._told = told
        return store

    def _disconnect(self, lane: str) -> None:
        store = self._stores.pop(lane, None)
        if store is not None:
            with suppress(FleetError):
                store.close()

    def _fail(self, lane: str, problem: str) -> None:
        """The store failed a lane, which leaves it alone for a while, longer each time; a full one still answers."""
        self._trouble(lane, problem)
        self._pause_s[lane] = min(_LONGEST_PAUSE_S, max(1.0, 2 * self._pause_s[lane]))
        self._again[lane] = time.monotonic() + self._pause_s[lane]
        self._disconnect(lane)

    def _trouble(self, part: str, problem: str) -> None:
        if self._ended.is_set():  # the outbox was closed under a thread that was left behind
            return
        with self._changed:
            _, since = self._troubles.get(part, ("", time.time()))
            known = problem in (text for text, _ in self._troubles.values())
            self._troubles[part] = problem, since
        if not known:
            self._say(f"fleet: {problem}")

    def _well(self, part: str) -> None:
        with self._changed:
            trouble = self._troubles.pop(part, None)
            others = [text for text, _ in self._troubles.values()]
        if part in _LANES:
            self._pause_s[part] = self._again[part] = 0.0
        if trouble is not None and trouble[0] not in others:
            self._say(f"fleet: well again after {time.time() - trouble[1]:.0f} s: {trouble[0]}")

    def _tally(self, **more: int) -> None:
        with self._changed:
            self._counts.update(more)

    def _guarded(self, run: Callable[[], None]) -> Callable[[], None]:
        def guarded() -> None:
            with suppress(OSError):  # where threads have no priority of their own
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
            try:
                run()
            except Exception as error:  # a defect: local recognition goes on, and it is said
                self._trouble(run.__name__, f"ended by {type(error).__name__}: {error}")
                raise

        return guarded

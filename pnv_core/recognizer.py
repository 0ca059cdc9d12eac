"""PlaceRecognizer: one frame in, its loop-closure candidates out. Deterministic, no clock, no ROS."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from pnv_core.config import Config, live_settings
from pnv_core.database import KeyframeDatabase
from pnv_core.database.selection import KeyframeSelector
from pnv_core.decide.consistency import DOUBT, SequenceMemory, window_of
from pnv_core.decide.gates import decided
from pnv_core.decide.judge import AROUND, Judge
from pnv_core.decide.odometry import Odometry
from pnv_core.describe.describer import Describer
from pnv_core.errors import ConfigError
from pnv_core.threads import workers
from pnv_core.timing import StageTimer, TimeBudget
from pnv_core.types import Frame, ImageRef, LoopClosure, PlaceDescriptor, Query

_LATEST_NS = 2**62  # later than any stamp


@dataclass(frozen=True, eq=False)
class Seen:
    """A new keyframe that was looked at and not looked up yet."""

    frame: Frame
    descriptor: PlaceDescriptor
    predecessor: float  # cosine to the keyframe before it, 1 where there is none
    config: Config  # at that time
    began: float  # by the driver's clock


class PlaceRecognizer:
    """Patch-NetVLAD over a rolling keyframe database, with the settings that its describer was built with.

    The same frames in the same order give the same closures, live, from a bag or in a test.
    """

    def __init__(
        self,
        describer: Describer,
        database: KeyframeDatabase | None = None,
        timer: StageTimer | None = None,
    ) -> None:
        self.config = describer.config  # the one Config; only its live settings change, by `change`
        self.describer = describer
        if database is None:  # an empty one is false
            database = KeyframeDatabase.for_describer(describer)
        self.database = database
        self.timer = timer or StageTimer()
        self.budget = TimeBudget(self.timer.clock)
        self.keyframes = KeyframeSelector(self.config)
        self._workers = workers(self.config.threads)
        self.judge = Judge(describer.config, describer.model.info.calibration, self.database.steps)
        self.sequence = SequenceMemory(self.database.steps)
        self.latest: Query | None = None  # of the last frame processed; None where it was no keyframe
        # what a driver that knows cameras keeps of a frame for poses, beside what the verifier kept
        self.geometry_of: Callable[[Frame, bytes], bytes] = lambda frame, kept: b""
        self.odometry = Odometry()  # a driver that has odometry calls odometry.add before the frames of that time

    @property
    def enough(self) -> tuple[int, int]:
        """(width, height) in pixels; what a larger image shows beyond that is not looked at."""
        width, height = self.describer.image_size
        return max(width, self.judge.verifier.side if self.config.verify else 0), height

    def process(self, frame: Frame) -> list[LoopClosure]:
        """Every candidate examined for the frame, best first, accepted or refused with a reason.

        Empty for a frame that is no keyframe or has no candidates. Raises ImageError for an unusable image.
        """
        self.latest = None
        seen = self.look(frame)
        return [] if seen is None else self.recognise(seen)

    def look(self, frame: Frame) -> Seen | None:
        """The first half of `process`: what a new keyframe shows; None for a frame that is none.

        Shares nothing with `recognise`, so that another thread may be at the frame before meanwhile; each half takes
        the frames in their order.
        """
        if not self.keyframes.due(frame):
            return None
        began = self.budget.now()
        with self.timer.stage("describe"):
            at_once = bool(self.config.verify) and self.keyframes.changing(frame)
            descriptor, kept = self._described(frame, at_once)
        if not self.keyframes.differs(frame, descriptor):
            if at_once and self._workers.threads > 1:
                kept()  # nothing is left running when a frame is done with
            return None
        predecessor = self.keyframes.similarity(frame, descriptor)
        self.keyframes.take(frame, descriptor)
        if self.config.verify:
            with self.timer.stage("features"):  # those that are not done yet
                descriptor = replace(descriptor, thumbnail=kept())
        return Seen(frame, descriptor, predecessor, self.config, began)

    def recognise(self, seen: Seen) -> list[LoopClosure]:
        """The second half of `process`: the candidates of a keyframe, which is remembered."""
        frame, descriptor, config = seen.frame, seen.descriptor, seen.config
        if descriptor.thumbnail:
            descriptor = replace(descriptor, geometry=self.geometry_of(frame, descriptor.thumbnail))
        with self.timer.stage("retrieve"):
            recent_ns = int(config.exclude_recent_s * 1e9)
            most = max(config.candidates, AROUND)
            around = self.database.nearest(descriptor.global_vector, most, frame.stamp_ns, recent_ns)
            candidates = around[: config.candidates]
        limit = self.budget.affordable(len(candidates), config.time_budget_ms / 1e3, seen.began)
        with self.timer.stage("rerank"), self.budget.taken(limit):
            tried = candidates[:limit]
            stored = self.database.readable(ref.id for ref, _ in tried)
            gone = {ref.id for ref, _ in tried} - set(stored)
            candidates = [(ref, similarity) for ref, similarity in candidates if ref.id not in gone]
            known = list(stored.values())
            query = ImageRef(-1, frame.stamp_ns, frame.camera, self.database.session)
            closures = self.judge.judge(query, descriptor, seen.predecessor, candidates, known, config, around)
        with self.timer.stage("store"):
            if not self.database.read_only:
                query = self.database.add(frame.stamp_ns, frame.camera, descriptor)
            self.odometry.remember(query)
        self.latest = Query(query, descriptor, seen.predecessor)
        closures = [replace(c, query=query) for c in closures]
        self.sequence.remember(frame.camera, closures, window_of(config.consistency + DOUBT))
        return sorted((self._decided(c, config) for c in closures), key=self.judge.order)

    def _described(self, frame: Frame, at_once: bool) -> tuple[PlaceDescriptor, Callable[[], bytes]]:
        """The descriptor, and what gives what the verifier keeps: made at the same time where that is wanted."""

        def keep() -> bytes:
            return self.judge.verifier.keep(frame.rgb, frame.camera, frame.valid)

        kept = self._workers.beside(keep) if at_once else keep
        try:
            return self.describer.describe(frame.rgb, frame.valid), kept
        except Exception:
            if at_once:
                with suppress(Exception):
                    kept()
            raise

    def look_up(self, frame: Frame) -> list[LoopClosure]:
        """Every candidate for an image by itself, best first; nothing is remembered, no keyframe is too young.

        Without a sequence only `sure_score` accepts. Raises ImageError for an unusable image.
        """
        descriptor, kept = self._described(frame, bool(self.config.verify))
        if self.config.verify:
            descriptor = replace(descriptor, thumbnail=kept())
        around = self.database.nearest(descriptor.global_vector, max(self.config.candidates, AROUND), _LATEST_NS, 0)
        candidates = around[: self.config.candidates]
        stored = self.database.readable(ref.id for ref, _ in candidates)
        candidates = [(ref, similarity) for ref, similarity in candidates if ref.id in stored]
        query = ImageRef(-1, frame.stamp_ns, frame.camera, self.database.session)
        closures = self.judge.judge(query, descriptor, 1.0, candidates, list(stored.values()), self.config, around)
        alone = SequenceMemory(self.database.steps)
        return sorted((decided(c, self.config, alone) for c in closures), key=self.judge.order)

    def change(self, **live: Any) -> None:
        """Take these live settings from the next frame on. Raises ConfigError for others and for a wrong value."""
        if fixed := [name for name in live if name not in live_settings(self.config)]:
            raise ConfigError(
                f"{', '.join(fixed)} cannot change while running; allowed: {', '.join(live_settings(self.config))}"
            )
        self.config = self.keyframes.config = self.config.replace(**live)

    def new_session(self) -> None:
        """What comes next is another run: its stamps may lie before those already seen."""
        self.database.new_session()
        self.forget_the_past()

    def reset(self) -> None:
        """Forget every keyframe."""
        self.database.clear()
        self.forget_the_past()

    def forget_the_past(self) -> None:
        """What went before says nothing about what comes: no predecessor, no sequence, no odometry."""
        self.keyframes.forget()
        self.sequence.forget()
        self.odometry.forget()

    def _decided(self, closure: LoopClosure, config: Config) -> LoopClosure:
        gate = config.odometry_drift, config.odometry_slack_m, config.min_travelled_m
        impossible = self.odometry.impossible(closure.query, closure.match, *gate)
        return decided(closure, config, self.sequence, impossible)

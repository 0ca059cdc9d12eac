"""PlaceRecognizer: one frame in, its loop-closure candidates out. Deterministic, no clock, no ROS."""

from dataclasses import replace

from pnv_core.config import Config
from pnv_core.database import KeyframeDatabase
from pnv_core.describer import Describer
from pnv_core.judging import Judge
from pnv_core.keyframes import KeyframeSelector
from pnv_core.local_features import thumbnail
from pnv_core.timing import StageTimer
from pnv_core.types import Frame, ImageRef, LoopClosure, Reason


class PlaceRecognizer:
    """Patch-NetVLAD over a rolling keyframe database.

    The same frames in the same order give the same closures, live, from a bag or in a test.
    """

    def __init__(
        self,
        config: Config,
        describer: Describer,
        database: KeyframeDatabase | None = None,
        timer: StageTimer | None = None,
    ) -> None:
        self.config = config
        self.describer = describer
        if database is None:  # an empty one is false
            database = KeyframeDatabase.from_config(describer.config, describer.model.global_dim)
        self.database = database
        self.timer = timer or StageTimer()
        self.keyframes = KeyframeSelector(config)
        self.judge = Judge(describer.config, describer.model.info.calibration)

    def process(self, frame: Frame) -> list[LoopClosure]:
        """Every candidate examined for the frame, best first, accepted or refused with a reason.

        Empty for a frame that is no keyframe or has no candidates. Raises ImageError for an unusable image.
        """
        if not self.keyframes.due(frame):
            return []
        with self.timer.stage("describe"):
            descriptor = self.describer.describe(frame.rgb, frame.valid)
        if not self.keyframes.differs(frame, descriptor):
            return []
        predecessor = self.keyframes.similarity(frame, descriptor)
        self.keyframes.take(frame, descriptor)
        if self.config.verify:
            descriptor = replace(descriptor, thumbnail=thumbnail(frame.rgb))
            self.judge.verifier.mask(frame.camera, frame.valid)
        with self.timer.stage("retrieve"):
            recent_ns = int(self.config.exclude_recent_s * 1e9)
            candidates = self.database.nearest(
                descriptor.global_vector, self.config.candidates, frame.stamp_ns, recent_ns
            )
        with self.timer.stage("rerank"):
            known = [(ref, similarity, self.database.descriptor(ref.id)) for ref, similarity in candidates]
            query = ImageRef(-1, frame.stamp_ns, frame.camera)
            closures = self.judge.judged(query, descriptor, predecessor, known, self.config.verify)
        with self.timer.stage("store"):
            if not self.database.read_only:
                query = self.database.add(frame.stamp_ns, frame.camera, descriptor)
        decided = [self._decided(replace(c, query=query)) for c in closures]
        return sorted(decided, key=lambda c: -c.score)

    def change(self, config: Config) -> None:
        """Take the live settings of another Config, from the next frame on."""
        self.config = self.keyframes.config = config

    def new_session(self) -> None:
        """What comes next is another run: its stamps may lie before those already seen."""
        self.database.new_session()
        self.keyframes.forget()

    def reset(self) -> None:
        """Forget every keyframe."""
        self.database.clear()
        self.keyframes.forget()

    def _decided(self, closure: LoopClosure) -> LoopClosure:
        if closure.evidence.texture < self.config.min_texture:
            return replace(closure, score=0.0, reason=Reason.LOW_TEXTURE)
        if closure.score < self.config.accept_score:
            return replace(closure, reason=Reason.LOW_SCORE)
        return replace(closure, accepted=True)

"""PlaceRecognizer: one frame in, its loop-closure candidates out. Deterministic, no clock, no ROS."""

from pnv_core.calibration import Evidence, Uncalibrated
from pnv_core.config import Config
from pnv_core.database import KeyframeDatabase
from pnv_core.describer import Describer
from pnv_core.keyframes import KeyframeSelector
from pnv_core.reranker import Reranker
from pnv_core.timing import StageTimer
from pnv_core.types import Frame, ImageRef, LoopClosure, PlaceDescriptor, Reason


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
        self.database = database or KeyframeDatabase.from_config(describer.config, describer.model.global_dim)
        self.timer = timer or StageTimer()
        self.keyframes = KeyframeSelector(config)
        self.reranker = Reranker(describer.config)
        self.calibration = Uncalibrated()

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
        self.keyframes.take(frame, descriptor)
        with self.timer.stage("retrieve"):
            candidates = self.database.nearest(
                descriptor.global_vector, self.config.candidates, frame.stamp_ns, int(self.config.exclude_recent_s * 1e9)
            )
        with self.timer.stage("rerank"):
            references = [(ref, similarity, self.database.descriptor(ref.id)) for ref, similarity in candidates]
            query = ImageRef(-1, frame.stamp_ns, frame.camera)
            closures = [self._examined(query, descriptor, *reference) for reference in references]
        with self.timer.stage("store"):
            query = self.database.add(frame.stamp_ns, frame.camera, descriptor)
        ranked = sorted(closures, key=lambda c: (-c.score, -c.similarity, c.match.id))
        return [self._decided(query, descriptor, c) for c in ranked]

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

    def _examined(self, query: ImageRef, descriptor: PlaceDescriptor, ref: ImageRef, similarity: float, reference: PlaceDescriptor) -> LoopClosure:
        spatial = self.reranker.score(descriptor, reference)
        score = self.calibration.probability(Evidence(similarity, spatial.score, spatial.inliers))
        return LoopClosure(query, ref, score, similarity, spatial.score, spatial.inliers, False, matches=spatial.matches)

    def _decided(self, query: ImageRef, descriptor: PlaceDescriptor, closure: LoopClosure) -> LoopClosure:
        if descriptor.texture < self.config.min_texture:
            reason = Reason.LOW_TEXTURE
        elif closure.score < self.config.accept_score:
            reason = Reason.LOW_SCORE
        else:
            reason = Reason.ACCEPTED
        return LoopClosure(
            query, closure.match, closure.score, closure.similarity, closure.spatial, closure.inliers,
            reason is Reason.ACCEPTED, reason, closure.matches,
        )

"""The recogniser as a state machine: features that work alone must hold when two meet.

Frames, sessions, resets, changed settings, eviction, saving, loading and thinning in any order, for 1 to 8 cameras,
with and without local features, against a plain model: lists, float64 and counting.
"""

import functools
import shutil
import tempfile
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from pnv_core import Config, Describer, Frame, ImageRef, KeyframeDatabase, MapStore, PlaceRecognizer, Reason
from pnv_core.decide.calibration import Calibration, Logistic
from pnv_core.maps.tools import prune
from test.core.small import HEIGHT, WIDTH, noise_image, small_model

SECOND = 10**9
PLACES = 6
_SCORES = Calibration(  # of no model; it lets scores of a revisit spread over 0 to 1
    Logistic(4.0, {"spatial": 3.0}), Logistic(4.0, {"accord": 1.0}),
    patch_sizes=(2, 5), image_size=(WIDTH, HEIGHT), verifier="xfeat", matched=Logistic(2.0, {"concord": 1.0}),
)  # fmt: skip


@functools.cache
def picture(place: int, visit: int) -> np.ndarray:
    """A place seen again: the same blocks under other noise."""
    noise = np.random.default_rng([place, visit]).normal(0, 12, (HEIGHT, WIDTH, 3))
    return (noise_image(place) * 0.8 + 20 + noise).clip(0, 255).astype(np.uint8)


@functools.cache
def model():
    return small_model().with_info(calibration=_SCORES.to_json())


_described: dict[tuple[int, int], object] = {}


def describer(config: Config) -> Describer:
    """Describes each picture once in this process: what the machine crosses lies behind the description."""
    made = Describer(model(), config)
    plain = made.describe

    def describe(rgb, valid=None):
        key = rgb.__array_interface__["data"][0], rgb.nbytes
        if key not in _described:
            _described[key] = plain(rgb, valid)
        return _described[key]

    made.describe = describe
    return made


class Crossing(RuleBasedStateMachine):
    @initialize(
        cameras=st.integers(1, 8),
        verify=st.sampled_from([0, 3]),
        eviction=st.sampled_from(["oldest", "densest"]),
        store=st.sampled_from(["memory", "disk"]),
        precision=st.sampled_from(["float16", "int8"]),
        budget_mb=st.sampled_from([0.12, 0.3, 4.0]),
        consistency=st.sampled_from([0, 2, 3]),
    )
    def start(self, cameras, verify, eviction, store, precision, budget_mb, consistency):
        self.folder = Path(tempfile.mkdtemp())
        self.cameras = [f"camera{i}" for i in range(cameras)]
        self.options = {"memory_budget_mb": budget_mb, "eviction": eviction, "patch_store": store,
                        "patch_precision": precision, "patch_folder": str(self.folder)}  # fmt: skip
        self.config = Config.make(verify=verify, consistency=consistency, threads=1, min_change=0.0,
                                  sure_score=1.1, exclude_recent_s=2.0, candidates=5)  # fmt: skip
        self.recognizer = self.made()
        self.twin, self.twin_since = None, 0
        self.saves = 0
        # the plain model
        self.now = 0
        self.seen_ids: set[int] = set()
        self.session = 0
        self.held: dict[int, tuple[ImageRef, np.ndarray]] = {}
        self.last: dict[str, int] = {}  # stamp of each camera's last keyframe

    def teardown(self):
        if hasattr(self, "folder"):
            shutil.rmtree(self.folder)

    def made(self):
        of = describer(self.config)
        database = KeyframeDatabase(of.model.global_dim, **self.options, cell=of.cell)
        return PlaceRecognizer(of, database)

    # what may happen

    @rule(
        pause=st.sampled_from([1, 3, 60]),
        first=st.integers(0, PLACES - 1),
        count=st.integers(3, 7),
        way=st.sampled_from([1, -1]),
        visit=st.integers(0, 2),
    )
    def drive(self, pause, first, count, way, visit):
        self.now += pause * SECOND
        for step in range(count):
            self.now += SECOND
            for offset, camera in enumerate(self.cameras):
                self.see(Frame(self.now + offset, camera, picture((first + way * step + 2 * offset) % PLACES, visit)))

    @rule(first=st.integers(0, PLACES - 1))
    def drive_a_lap_twice(self, first):
        self.drive(3, first, PLACES, 1, 0)
        self.drive(3, first, PLACES, 1, 1)

    @rule()
    def a_frame_too_early_is_none(self):
        camera = self.cameras[0]
        if camera in self.last:
            frame = Frame(self.last[camera] + int(self.config.min_interval_s * 1e9) - 1, camera, picture(0, 0))
            before = self.recognizer.database.refs()
            assert self.recognizer.process(frame) == []
            assert self.recognizer.latest is None
            assert self.recognizer.database.refs() == before

    @rule(back_s=st.integers(0, 1000))
    def new_session(self, back_s):
        self.recognizer.new_session()
        if self.twin:
            self.twin.new_session()
        self.session += 1
        self.now -= back_s * SECOND
        self.forget()

    @rule()
    def reset(self):
        self.recognizer.reset()
        self.twin = None
        self.held.clear()
        self.forget()

    @rule(accept=st.sampled_from([0.0, 0.3, 0.5, 0.9]), sure=st.sampled_from([0.7, 1.1]),
          candidates=st.integers(1, 8), exclude=st.sampled_from([0.0, 2.0, 30.0]))  # fmt: skip
    def change(self, accept, sure, candidates, exclude):
        live = {"accept_score": accept, "sure_score": sure, "candidates": candidates, "exclude_recent_s": exclude}
        self.config = self.config.replace(**live)
        self.recognizer.change(**live)
        if self.twin:
            self.twin.change(**live)

    @precondition(lambda self: self.held)
    @rule()
    def a_saved_and_loaded_map_goes_on_as_the_one_that_was_not(self):
        path = self.save()
        self.twin = self.made()
        MapStore(path, "model").load(self.twin.database)
        self.recognizer.new_session()
        self.session += 1
        self.forget()
        assert self.twin.database.refs() == self.recognizer.database.refs()
        for keyframe in self.held:
            ours, theirs = (r.database.descriptor(keyframe) for r in (self.recognizer, self.twin))
            assert ours.thumbnail == theirs.thumbnail
            assert ours.texture == theirs.texture
            for a, b in zip(ours.patches, theirs.patches, strict=True):
                assert np.array_equal(a.descriptors, b.descriptors)
        self.twin_since = self.recognizer.database.evicted, self.twin.database.evicted

    @precondition(lambda self: len(self.held) > 3)
    @rule(
        share=st.sampled_from([0.3, 0.6]), eviction=st.sampled_from(["oldest", "densest"]), without_newest=st.booleans()
    )
    def a_thinned_map_is_loaded_into_another_recogniser(self, share, eviction, without_newest):
        thin = self.folder / f"thin{self.saves}"
        newest = max(kf.session for kf, _ in self.held.values())
        dropped = [newest] if without_newest else []
        kept = [kf for kf, _ in self.held.values() if kf.session not in dropped]
        keep = int(share * len(kept))
        prune(self.save(), thin, keep=keep, eviction=eviction, drop_sessions=dropped)
        self.recognizer, self.twin = self.made(), None
        MapStore(thin, "model").load(self.recognizer.database)
        self.session += 1
        left = {ref.id for ref in self.recognizer.database.refs()}
        assert len(left) == keep
        assert left <= set(self.held)
        self.held = {i: kf for i, kf in self.held.items() if i in left}
        self.forget()

    # what must hold

    def see(self, frame):
        recognizer, config = self.recognizer, self.config
        before, evicted = dict(self.held), recognizer.database.evicted
        closures = recognizer.process(frame)
        due = frame.camera not in self.last or frame.stamp_ns - self.last[frame.camera] >= config.min_interval_s * 1e9
        assert (recognizer.latest is not None) == due
        if self.twin:
            self.compare(frame, closures)
        if not due:
            assert closures == []
            return
        self.last[frame.camera] = frame.stamp_ns
        ref, vector = recognizer.latest.ref, recognizer.latest.descriptor.global_vector.astype(np.float64)
        assert (ref.stamp_ns, ref.camera, ref.session) == (frame.stamp_ns, frame.camera, self.session)
        assert ref.id not in self.seen_ids
        assert ref.id > max(self.seen_ids, default=-1)
        self.seen_ids.add(ref.id)
        self.found(closures, ref, vector, before)
        self.held[ref.id] = ref, vector
        self.given_up(recognizer.database, evicted)
        self.decided(closures, ref)

    def found(self, closures, ref, vector, before):
        """The candidates are the most similar keyframes outside the exclusion window, by brute force."""
        limit = ref.stamp_ns - int(self.config.exclude_recent_s * 1e9)
        allowed = [kf for kf, _ in before.values() if kf.session != ref.session or kf.stamp_ns <= limit]
        similarity = {kf.id: float(before[kf.id][1] @ vector) for kf in allowed}
        best = sorted(similarity.values(), reverse=True)[: self.config.candidates]
        assert len(closures) == len(best)
        assert len({c.match.id for c in closures}) == len(closures)
        given = sorted((similarity[c.match.id] for c in closures), reverse=True)
        assert np.allclose(given, best, atol=1e-6)
        for c in closures:
            assert c.match == before[c.match.id][0]
            assert abs(c.similarity - similarity[c.match.id]) < 1e-5

    def given_up(self, database, evicted):
        """Only what the policy names goes, one after another, and the budget holds."""
        left = {r.id for r in database.refs()}
        assert left <= set(self.held)
        assert database.evicted - evicted == len(self.held) - len(left)
        assert database.bytes_used <= database.bytes_budget
        newest = max(self.held)
        assert newest in left
        going = set(self.held) - left
        while going:
            others = {i: kf for i, kf in self.held.items() if i != newest}
            if self.options["eviction"] == "oldest":
                gone = min(others)
                assert gone in going
            else:
                redundant = {i: redundancy(i, others) for i in others}
                gone = max(going, key=redundant.__getitem__)
                assert redundant[gone] >= max(redundant.values()) - 1e-5
            going.discard(gone)
            del self.held[gone]

    def decided(self, closures, ref):
        """Every refusal has its reason, every acceptance none; sequences are counted per camera in what is left."""
        config = self.config
        for c in closures:
            assert c.query == ref
            assert 0.0 <= c.score <= 1.0
            assert c.accepted == (c.reason is Reason.ACCEPTED)
            if c.accepted:
                assert c.score >= config.accept_score
                assert not config.verify or c.evidence.local_inliers >= 0
            close = [o.evidence.local_inliers for o in closures if o.match.session == c.match.session
                     and abs(self.steps(o.match, c.match)) <= 10]  # fmt: skip
            outdone = c.evidence.local_inliers >= 0 and max(close) > 3 * c.evidence.local_inliers
            assert not (outdone and c.accepted)
            if c.reason is Reason.UNCONFIRMED and not outdone:
                assert config.consistency > 1
                assert c.score < config.sure_score
            for other in (o.match for o in closures if same_sequence(o.match, c.match)):
                assert self.recognizer.sequence._steps(other, c.match) == self.steps(other, c.match)

    def steps(self, earlier, later):
        sequence = [kf.id for kf, _ in self.held.values() if same_sequence(kf, later)]
        return sum(i < later.id for i in sequence) - sum(i < earlier.id for i in sequence)

    def compare(self, frame, closures):
        theirs = self.twin.process(frame)
        if (self.recognizer.database.evicted, self.twin.database.evicted) != self.twin_since:
            self.twin = None  # rows that are free again are not saved: one may have to give up a keyframe earlier
            return
        assert theirs == closures

    def save(self):
        """A new folder, or the same once more."""
        path = self.folder / f"map{self.saves}"
        self.saves += 1
        MapStore(path, "model").save(self.recognizer.database.snapshot())
        return path

    def forget(self):
        self.last.clear()


def same_sequence(a, b):
    return (a.session, a.camera) == (b.session, b.camera)


def redundancy(keyframe, held):
    """The lesser cosine to the neighbours in time of the same session and camera; -1 at the ends of a run."""
    own = held[keyframe][0]
    run = sorted(i for i, (kf, _) in held.items() if same_sequence(kf, own))
    at = run.index(keyframe)
    if at in (0, len(run) - 1):
        return -1.0
    return float(min(held[keyframe][1] @ held[other][1] for other in (run[at - 1], run[at + 1])))


class TestCrossing(Crossing.TestCase):
    settings = settings(max_examples=16, stateful_step_count=12, deadline=None, derandomize=True,
                        phases=[Phase.generate],  # a shorter example would cost minutes
                        suppress_health_check=list(HealthCheck))  # fmt: skip

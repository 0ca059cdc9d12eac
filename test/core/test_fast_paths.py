"""The fast formulations against their definitions: float64, OpenCV, brute force, and the plain path without kernels."""

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st

from pnv_core import kernels
from pnv_core.describe.patches import PatchAggregator, bfloat16_is_fast, patch_descriptors
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.threads import spans, workers
from pnv_core.timing import StageTimer, TimeBudget
from pnv_core.types import Frame, Reason
from pnv_core.verify import matching, spatial
from pnv_core.verify.matching import mutual_nearest, patch_rows
from pnv_core.verify.reranker import Reranker
from pnv_core.verify.spatial import homography_inliers
from test.core.small import HEIGHT, WIDTH, small_describer

compiled = pytest.mark.skipif(not kernels.COMPILED, reason="numba is not installed")


def local_descriptors(seed, clusters, channels, dim, shape, sharpness):
    rng = torch.Generator().manual_seed(seed)
    x = F.normalize(torch.randn(channels, shape[0] * shape[1], generator=rng) + 0.5, dim=0)
    centroids = F.normalize(torch.randn(clusters, channels, generator=rng) + 0.5, dim=1) * 0.8
    weights = torch.softmax(sharpness * centroids @ x, dim=0)
    return x, weights, centroids, torch.randn(dim, clusters * channels, generator=rng), torch.randn(dim, generator=rng)


@compiled
@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 999),
    clusters=st.integers(1, 7),
    channels=st.integers(2, 40),
    dim=st.integers(1, 150),
    height=st.integers(6, 11),
    width=st.integers(6, 13),
    sharpness=st.sampled_from([1.0, 30.0, 200.0]),
    windows=st.lists(st.tuples(st.integers(1, 6), st.integers(1, 3)), min_size=1, max_size=4),
    threads=st.integers(1, 3),
)
def test_aggregated_patches_equal_the_definition_in_float64(
    seed, clusters, channels, dim, height, width, sharpness, windows, threads
):
    x, weights, centroids, projection, bias = local_descriptors(
        seed, clusters, channels, dim, (height, width), sharpness
    )
    sizes, strides = zip(*windows, strict=True)
    given_rows = PatchAggregator(centroids, projection, bias, workers(threads))(
        x, weights, (height, width), sizes, strides
    )
    exact = patch_descriptors(
        *(v.double() for v in (x, weights, centroids, projection, bias)), (height, width), sizes, strides
    )
    for rows, expected in zip(given_rows, exact, strict=True):
        assert rows.shape == tuple(expected.shape)
        assert np.abs(rows - expected.numpy()).max() < 2e-5


@compiled
def test_windows_whose_residuals_cancel_keep_their_direction():
    """Two descriptors on opposite sides of a centroid leave a residual a thousand times smaller than either."""
    channels, shape = 8, (4, 4)
    centroid = torch.full((1, channels), 0.3)
    step = torch.zeros(channels, 16)
    step[0] = torch.tensor([0.5, -0.5] * 8)
    step[1] = 1e-3
    x = centroid.T + step
    projection = torch.eye(channels)
    rows = PatchAggregator(centroid, projection, torch.zeros(channels), workers(1))(
        x, torch.ones(1, 16), shape, (2,), (1,)
    )[0]
    assert np.abs(rows[:, 1] - 1).max() < 1e-3


@compiled
def test_patches_that_no_cluster_touches_are_zero():
    x, weights, centroids, projection, bias = local_descriptors(1, 4, 16, 24, (8, 9), 10.0)
    weights.view(4, 8, 9)[:, :, :5] = 0
    fast = PatchAggregator(centroids, projection, bias, workers(2))(x, weights, (8, 9), (2, 3), (1, 1))
    plain = patch_descriptors(x, weights, centroids, projection, bias, (8, 9), (2, 3), (1, 1))
    for rows, expected in zip(fast, plain, strict=True):
        assert np.array_equal(~rows.any(1), ~expected.numpy().any(1))
        assert (~rows.any(1)).sum() > 10
        assert np.allclose(rows, expected.numpy(), atol=1e-5)


@compiled
@pytest.mark.skipif(not bfloat16_is_fast(), reason="the processor has no bfloat16 products")
def test_fast_patches_are_nearly_the_exact_ones():
    x, weights, centroids, projection, bias = local_descriptors(2, 16, 128, 64, (15, 20), 40.0)
    exact, fast = (
        PatchAggregator(centroids, projection, bias, workers(2), mode)(x, weights, (15, 20), (2, 5), (1, 1))
        for mode in (False, True)
    )
    for a, b in zip(exact, fast, strict=True):
        assert (1 - (a * b).sum(1)).max() < 1e-4
        assert not np.array_equal(a, b)


@compiled
@settings(deadline=None, max_examples=150)
@given(
    seed=st.integers(0, 10**6),
    count=st.integers(5, 120),
    share=st.floats(0, 1),
    noise=st.sampled_from([0.0, 3.0, 10.0]),
)
def test_inliers_are_those_of_opencv(seed, count, share, noise):
    """Matches on the 16 px grid, a share of them by one homography."""
    rng = np.random.default_rng(seed)
    source = 16 * rng.integers(0, [40, 30], (count, 2)) + 15
    angle, zoom = rng.uniform(-0.3, 0.3), rng.uniform(0.8, 1.2)
    turn = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    target = source @ turn.T + rng.uniform(-50, 50, 2) + rng.normal(0, noise, (count, 2))
    random = rng.random(count) > share
    target[random] = rng.uniform(0, [640, 480], (int(random.sum()), 2))
    target = 16 * np.round(target / 16) + 15
    points = source.astype(np.float32), target.astype(np.float32)
    _, mask = cv2.findHomography(*points, cv2.RANSAC, 24.0)
    expected = np.zeros(count, bool) if mask is None else mask.ravel().astype(bool)
    assert np.array_equal(homography_inliers(*points, 24.0), expected)


@settings(deadline=None)
@given(
    seed=st.integers(0, 999),
    shape=st.tuples(st.integers(1, 90), st.integers(1, 90)),
    dim=st.integers(2, 70),
    closeness=st.sampled_from([0.0, 1e-3, 0.3]),
    half=st.booleans(),
)
def test_screened_matches_are_the_exact_ones(seed, shape, dim, closeness, half):
    """`closeness` of the rows to one another makes many nearly equal similarities."""
    rng = np.random.default_rng(seed)
    query, reference = (rng.normal(size=(n, dim)) * (closeness or 1) + (closeness > 0) for n in shape)
    query, reference = (
        (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float16 if half else np.float32)
        for rows in (query, reference)
    )
    similarity = reference.astype(np.float64) @ query.astype(np.float64).T
    forward, backward = similarity.argmax(1), similarity.argmax(0)
    expected = {(int(forward[j]), j) for j in range(len(reference)) if backward[forward[j]] == j}
    given_pairs = set(zip(*(side.tolist() for side in mutual_nearest(query, reference)), strict=True))
    for i, j in given_pairs ^ expected:  # only where float32 cannot tell the best from the second best
        row, column = np.sort(similarity[:, i])[::-1], np.sort(similarity[j])[::-1]
        gaps = [best[0] - best[1] for best in (row, column) if len(best) > 1]
        assert min(gaps) < 1e-6


@compiled
def test_halves_are_unpacked_to_the_bit():
    values = np.arange(2**16, dtype=np.uint16).view(np.float16)
    finite = values[np.isfinite(values)].reshape(-1, 2)
    assert np.array_equal(patch_rows(finite).rows.view(np.uint32), finite.astype(np.float32).view(np.uint32))


def test_the_plain_path_gives_the_same_descriptor_and_scores(monkeypatch):
    image = np.random.default_rng(5).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    fast = small_describer()
    descriptor = fast.describe(image)
    matches = Reranker(fast.config).score(descriptor, descriptor)
    monkeypatch.setattr(kernels, "COMPILED", False)
    monkeypatch.setattr(matching, "_QUANTISED", False)
    assert spatial.kernels is kernels
    plain = small_describer()
    assert plain.aggregator is None
    other = plain.describe(image)
    for a, b in zip(descriptor.patches, other.patches, strict=True):
        assert np.abs(a.descriptors - b.descriptors).max() < 1e-5
    assert Reranker(plain.config).score(other, other).score == pytest.approx(matches.score, abs=1e-6)


@pytest.mark.skipif(not bfloat16_is_fast(), reason="the processor has no bfloat16 products")
def test_a_bfloat16_trunk_describes_alike_and_leaves_the_model_as_it_was():
    from pnv_core import load_describer

    image = cv2.resize(np.random.default_rng(6).integers(0, 256, (30, 40, 3), np.uint8), (320, 240))
    one, other = load_describer(), load_describer(trunk_precision="bfloat16")
    a, b = one.describe(image), other.describe(image)
    assert 1 - a.global_vector @ b.global_vector < 3e-2
    assert not np.array_equal(a.global_vector, b.global_vector)
    assert one.fingerprint == other.fingerprint
    assert all(p.dtype == torch.float32 for p in other.model.trunk.parameters())


class Clock:
    """Seconds that pass only when told."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def test_a_time_budget_allows_as_many_candidates_as_fit():
    clock = Clock()
    budget = TimeBudget(clock)
    budget.start()
    assert budget.affordable(20, 0.05) == 20  # nothing is known yet
    with budget.taken(10):
        clock.now += 0.1  # 10 ms each
    budget.start()
    clock.now += 0.02
    assert budget.affordable(20, 0.0) == 20  # no budget
    assert budget.affordable(20, 0.1001) == 8
    assert budget.affordable(5, 0.1001) == 5
    assert budget.affordable(20, 0.001) == 1  # never none
    assert TimeBudget(None).affordable(20, 0.001) == 20


def test_candidates_beyond_the_budget_are_reported_as_not_re_ranked():
    describer = small_describer(min_interval_s=0.0, min_change=0.0, exclude_recent_s=0.0, time_budget_ms=110.0)
    clock = Clock()
    recogniser = PlaceRecognizer(describer, timer=StageTimer(clock))
    scores = recogniser.judge.reranker.scores

    def slow(query, references):
        clock.now += 0.05 * len(references)  # 50 ms each
        return scores(query, references)

    recogniser.judge.reranker.scores = slow
    read, descriptor = [], recogniser.database.descriptor
    recogniser.database.descriptor = lambda keyframe: read.append(keyframe) or descriptor(keyframe)
    rng = np.random.default_rng(7)
    for second in range(6):
        image = rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
        read.clear()
        closures = recogniser.process(Frame(second * 10**9, "camera", image))
    left_out = [c for c in closures if c.reason is Reason.NOT_RERANKED]
    assert len(closures) == 5
    assert len(left_out) == 3
    assert sorted(read) == sorted({c.match.id for c in closures} - {c.match.id for c in left_out})  # perhaps from disk
    assert not any(c.accepted for c in left_out)


def test_worker_threads_use_one_torch_thread_and_leave_the_others_theirs():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        pool = workers(3)
        assert pool.map(lambda _: torch.get_num_threads(), range(6)) == [1] * 6
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    with pytest.raises(ZeroDivisionError):
        pool.map(lambda part: 1 // part, [1, 0])


@given(length=st.integers(1, 500), parts=st.integers(1, 9), align=st.sampled_from([1, 16, 64]))
def test_spans_cover_everything_once(length, parts, align):
    cut = spans(length, parts, align)
    assert [n for a, b in cut for n in range(a, b)] == list(range(length))
    assert len(cut) <= parts
    assert all(a % align == 0 for a, _ in cut)

"""The fast formulations against their definitions: float64, OpenCV, brute force, the plain formulation in torch."""

import os
import subprocess
import sys
import threading

import cv2
import numpy as np
import openvino as ov
import pytest
import threadpoolctl
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from openvino import opset15 as ops

from pnv_core import KeyframeDatabase, MapStore, load_describer
from pnv_core.describe.model_files import ModelInfo, build_model
from pnv_core.describe.openvino_describing import head
from pnv_core.describe.patches import patch_descriptors
from pnv_core.describe.trunks.lite import lite_trunk
from pnv_core.errors import ConfigError
from pnv_core.networks.layers import Conv, Relu, same_pads, tensor_shapes
from pnv_core.networks.openvino_backend import (
    Compiled,
    _rounded,
    _rounded_with_sums,
    build,
    fast_precisions,
    image_input,
)
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.threads import alone, shared, spans, workers
from pnv_core.timing import StageTimer, TimeBudget
from pnv_core.types import Frame, Reason
from pnv_core.verify.homography import homography_inliers, usac_inliers
from pnv_core.verify.matching import mutual_maxima, mutual_nearest, patch_rows
from pnv_core.verify.reranker import Reranker
from test.core.small import HEIGHT, WIDTH, small_describer


def local_descriptors(seed, clusters, channels, dim, shape, sharpness):
    """Features (C, h, w) and a model's tensors around them."""
    rng = torch.Generator().manual_seed(seed)
    features = torch.randn(channels, *shape, generator=rng) + 0.5
    centroids = F.normalize(torch.randn(clusters, channels, generator=rng) + 0.5, dim=1) * 0.8
    return features, {
        "netvlad.centroids": centroids,
        "netvlad.assignment": sharpness * centroids,
        "global_projection.weight": torch.randn(dim, clusters * channels, generator=rng),
        "global_projection.bias": torch.randn(dim, generator=rng),
    }


def aggregated(features, tensors, windows, counted=None):
    """The patches of the OpenVINO graph."""
    channels = features.shape[0]
    trunk = {"neck.weight": np.zeros((channels, 672, 1, 1)), "neck.bias": np.zeros(channels)}
    arrays = {name: tensor.numpy() for name, tensor in tensors.items()} | {f"trunk.{n}": t for n, t in trunk.items()}
    shapes = lite_trunk(neck=channels).tensor_shapes()
    arrays |= {f"trunk.{name}": np.zeros(shape) for name, shape in shapes.items() if f"trunk.{name}" not in arrays}
    model = build_model(ModelInfo("lite", {"neck": channels}), arrays, "test")
    cells = features.shape[1:]
    counted = np.ones((1, 1, *cells), np.float32) if counted is None else counted
    wide = np.zeros((1, model.trunk.width, *cells), np.float32)
    return Compiled(lambda: head(model, cells, windows), 1)(features.numpy()[None], wide, counted)[1:]


def defined(features, tensors, windows, counted=None):
    """The definition in float64."""
    centroids, assignment, projection, bias = (t.double() for t in tensors.values())
    x = F.normalize(features.double().flatten(1), dim=0)
    weights = torch.softmax(assignment @ x, dim=0)
    if counted is not None:
        weights = weights * torch.from_numpy(counted.ravel()).double()
    sizes, strides = zip(*windows, strict=True)
    shape = tuple(features.shape[1:])
    return [rows.numpy() for rows in patch_descriptors(x, weights, centroids, projection, bias, shape, sizes, strides)]


@settings(deadline=None, max_examples=15)
@given(
    seed=st.integers(0, 999),
    clusters=st.integers(1, 7),
    channels=st.integers(2, 40),
    dim=st.integers(1, 40),
    height=st.integers(6, 11),
    width=st.integers(6, 13),
    sharpness=st.sampled_from([1.0, 30.0, 200.0]),
    windows=st.lists(st.tuples(st.integers(1, 6), st.integers(1, 3)), min_size=1, max_size=3),
)
def test_aggregated_patches_equal_the_definition_in_float64(
    seed, clusters, channels, dim, height, width, sharpness, windows
):
    features, tensors = local_descriptors(seed, clusters, channels, dim, (height, width), sharpness)
    for rows, expected in zip(aggregated(features, tensors, windows), defined(features, tensors, windows), strict=True):
        assert rows.shape == expected.shape
        assert np.abs(rows - expected).max() < 2e-5


def test_windows_whose_residuals_cancel_keep_their_direction():
    """Two descriptors on opposite sides of a centroid leave a residual a thousand times smaller than either."""
    channels, size = 8, (4, 4)
    centroid = torch.full((1, channels), 0.3)
    step = torch.zeros(channels, 16)
    step[0] = torch.tensor([0.5, -0.5] * 8)
    step[1] = 1e-3
    features = (centroid.T + step).view(channels, *size)
    lengths = features.norm(dim=0).mean()  # the graph makes them unit; the columns are nearly equally long
    tensors = {
        "netvlad.centroids": centroid / lengths,
        "netvlad.assignment": torch.zeros(1, channels),
        "global_projection.weight": torch.eye(channels),
        "global_projection.bias": torch.zeros(channels),
    }
    windows = [(2, 1)]
    (rows,), (expected,) = aggregated(features, tensors, windows), defined(features, tensors, windows)
    assert np.abs(rows - expected).max() < 1e-3


def test_patches_that_no_cluster_touches_are_zero():
    features, tensors = local_descriptors(1, 4, 16, 24, (8, 9), 10.0)
    counted = np.ones((1, 1, 8, 9), np.float32)
    counted[:, :, :, :5] = 0
    windows = [(2, 1), (3, 1)]
    for rows, expected in zip(
        aggregated(features, tensors, windows, counted), defined(features, tensors, windows, counted), strict=True
    ):
        assert np.array_equal(~rows.any(1), ~expected.any(1))
        assert (~rows.any(1)).sum() > 10
        assert np.allclose(rows, expected, atol=1e-5)


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


@given(
    table=st.integers(1, 9).flatmap(
        lambda q: st.lists(st.lists(st.integers(-2, 2), min_size=q, max_size=q), min_size=1, max_size=9)
    )
)
def test_of_equal_similarities_the_first_wins_and_zeros_match_nothing(table):
    similarity = np.array(table, np.float32)
    columns = list(zip(*table, strict=True))
    expected = [
        (row.index(max(row)), j)
        for j, row in enumerate(table)
        if any(row) and any(columns[row.index(max(row))]) and columns[row.index(max(row))].index(max(row)) == j
        and max(columns[row.index(max(row))]) == max(row)
    ]  # fmt: skip
    assert list(zip(*(side.tolist() for side in mutual_maxima(similarity)), strict=True)) == expected


def test_halves_are_unpacked_to_the_bit():
    values = np.arange(2**16, dtype=np.uint16).view(np.float16)
    finite = values[np.isfinite(values)].reshape(-1, 2)
    assert np.array_equal(patch_rows(finite).view(np.uint32), finite.astype(np.float32).view(np.uint32))


@pytest.mark.parametrize("settings", [{}, {"image_width": 650, "image_height": 490, "patch_sizes": (2, 5)}])
def test_both_backends_describe_alike(settings):
    """Whatever the size, with a mask or without."""
    image = cv2.resize(np.random.default_rng(5).integers(0, 256, (30, 40, 3), np.uint8), (640, 480))
    valid = np.ones((480, 640), bool)
    valid[:300] = False
    plain, fast = (load_describer(backend=b, trunk_precision="float32", **settings) for b in ("torch", "auto"))
    assert (plain.backend, fast.backend) == ("torch", "openvino")
    assert plain.map_fingerprint == fast.map_fingerprint
    for mask in (None, valid):
        a, b = plain.describe(image, mask), fast.describe(image, mask)
        assert np.abs(a.global_vector - b.global_vector).max() < 1e-5
        for p, q in zip(a.patches, b.patches, strict=True):
            assert np.abs(p.descriptors - q.descriptors).max() < 1e-5


@pytest.mark.parametrize("backend", ["torch", "openvino"])
def test_a_bfloat16_trunk_describes_alike(backend):
    if "BF16" not in fast_precisions():
        pytest.skip("the processor has no bfloat16 products")
    image = cv2.resize(np.random.default_rng(6).integers(0, 256, (30, 40, 3), np.uint8), (320, 240))
    one, other = (load_describer(backend=backend, trunk_precision=p) for p in ("float32", "bfloat16"))
    a, b = one.describe(image), other.describe(image)
    assert 1 - a.global_vector @ b.global_vector < (3e-2 if backend == "torch" else 3e-3)
    assert not np.array_equal(a.global_vector, b.global_vector)
    assert one.fingerprint == other.fingerprint
    assert one.map_fingerprint == other.map_fingerprint


@pytest.mark.parametrize(("fast", "expected"), [(["FP32", "BF16"], "bfloat16"), (["FP32", "INT8"], "float32")])
def test_auto_precision_is_what_the_processor_multiplies(monkeypatch, fast, expected):
    monkeypatch.setattr("pnv_core.networks.openvino_backend.fast_precisions", lambda: fast)
    assert load_describer().config.trunk_precision == expected
    assert load_describer(trunk_precision="float32").config.trunk_precision == "float32"
    assert load_describer(backend="torch").config.trunk_precision == "float32"
    assert small_describer().config.trunk_precision == "float32"  # a trunk without precise layers


def test_kernels_are_rounded_to_bfloat16_and_keep_their_sum():
    kernels = np.random.default_rng(3).standard_normal((40, 1, 5, 5)).astype(np.float32) * 3
    kernels -= kernels.mean((1, 2, 3), keepdims=True)
    assert np.array_equal(_rounded(kernels), torch.from_numpy(kernels).bfloat16().float().numpy())
    rounded = _rounded_with_sums(kernels)
    assert np.array_equal(rounded, torch.from_numpy(rounded).bfloat16().float().numpy())
    assert (np.abs(rounded - kernels) <= np.abs(kernels) / 64 + 1e-3).all()
    plain = np.abs(_rounded(kernels).sum((1, 2, 3), dtype=np.float64)).mean()
    assert np.abs(rounded.sum((1, 2, 3), dtype=np.float64)).mean() < plain / 10


def test_bfloat16_layers_compute_what_torch_does_with_weights_and_maps_rounded():
    if "BF16" not in fast_precisions():
        pytest.skip("the processor has no bfloat16 products")
    network = (Conv("a", 8, 3, pads=same_pads(3)), Relu(6.0), Conv("b", 4))
    rng = np.random.default_rng(4)
    weights = {name: rng.standard_normal(shape).astype(np.float32) for name, shape in tensor_shapes(network, 3).items()}
    weights |= {name: 20 * value for name, value in weights.items() if name.endswith("bias")}
    image = rng.integers(0, 256, (1, 16, 16, 3), np.uint8)

    def graph():
        pixels, x = image_input(16, 16)
        return ov.Model([ops.convert(build(network, weights, ops.convert(x, "bf16")), "f32")], [pixels], "half")

    def half(values):
        return values.bfloat16().double()

    tensors = {name: torch.from_numpy(value).double() for name, value in weights.items()}
    x = half(torch.from_numpy(image).permute(0, 3, 1, 2).double() / 255)
    x = half(F.conv2d(x, half(tensors["a.weight"]), tensors["a.bias"], padding=1).clamp(0, 6))
    expected = half(F.conv2d(x, half(tensors["b.weight"]), tensors["b.bias"]))
    found = Compiled(graph, 1)(image)[0]
    assert np.abs(found - expected.numpy()).max() < 2**-7 * expected.abs().max()
    assert abs((found - expected.numpy()).mean()) < 2**-11 * expected.abs().max()


@pytest.mark.parametrize(
    "settings", [[{"trunk_precision": "float32"}, {"trunk_precision": "bfloat16"}], [{"threads": 1}, {"threads": 2}]]
)
def test_each_precision_and_number_of_threads_finds_what_it_compiled(tmp_path, monkeypatch, settings):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    image = np.random.default_rng(8).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    made = [load_describer(verify=0, **own).describe(image).global_vector for own in settings]
    kept = {file: file.stat().st_mtime_ns for file in (tmp_path / "pnv_ros" / "openvino").iterdir()}
    assert len(kept) == 2
    found = [load_describer(verify=0, **own).describe(image).global_vector for own in settings]
    assert all(np.array_equal(a, b) for a, b in zip(made, found, strict=True))
    assert {file: file.stat().st_mtime_ns for file in kept} == kept


@pytest.mark.parametrize("order", [("float32", "bfloat16"), ("bfloat16", "float32")])
def test_a_map_saved_in_one_precision_serves_in_the_other(tmp_path, order):
    if "BF16" not in fast_precisions():
        pytest.skip("the processor has no bfloat16 products")
    saving, loading = (load_describer(trunk_precision=precision) for precision in order)
    grids = [(4, 3), (16, 12), (64, 48)]
    places = [
        sum(cv2.resize(random.integers(0, 86, (h, w, 3), np.uint8), (384, 288)) for w, h in grids)
        for random in map(np.random.default_rng, range(8))
    ]
    database = KeyframeDatabase.for_describer(saving)
    for number, picture in enumerate(places):
        database.add(number * 10**9, "camera", saving.describe(picture))
    MapStore(tmp_path / "map", saving.map_fingerprint).save(database.snapshot())
    loaded = KeyframeDatabase.for_describer(loading)
    MapStore(tmp_path / "map", loading.map_fingerprint).load(loaded)
    for number, picture in enumerate(places):
        described = loading.describe(picture)
        (match, cosine), (_, second) = loaded.nearest(described.global_vector, 2, 10**12, 0)
        assert match.id == number
        assert 1 - cosine < 0.002 < 1 - second  # of another place it is 0.3 and more
        (query,), (stored,) = described.patches, loaded.descriptor(number).patches
        own = (query.descriptors * stored.descriptors.astype(np.float32)).sum(1)
        assert np.median(1 - own) < 0.002
        matched, reference = mutual_nearest(query.descriptors, stored.descriptors)
        assert np.mean(matched == reference) > 0.9


def test_what_was_compiled_and_damaged_is_compiled_again(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    image = np.random.default_rng(8).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    expected = small_describer().describe(image).global_vector
    (kept,) = (tmp_path / "pnv_ros" / "openvino").iterdir()
    whole = kept.read_bytes()
    for damaged in (whole[: len(whole) // 2], b"", whole[:-9] + b"?" + whole[-8:]):
        kept.write_bytes(damaged)
        assert np.array_equal(small_describer().describe(image).global_vector, expected)
        assert len(kept.read_bytes()) == len(whole)


def test_openvino_on_cuda_is_refused():
    with pytest.raises(ConfigError, match="backend = 'openvino' runs on the processor"):
        load_describer(backend="openvino", device="cuda")


class Clock:
    """Seconds that pass only when told."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def test_a_time_budget_allows_as_many_candidates_as_fit():
    clock = Clock()
    budget = TimeBudget(clock)
    assert budget.affordable(20, 0.05, budget.now()) == 20  # nothing is known yet
    with budget.taken(10):
        clock.now += 0.1  # 10 ms each
    began = budget.now()
    clock.now += 0.02
    assert budget.affordable(20, 0.0, began) == 20  # no budget
    assert budget.affordable(20, 0.1001, began) == 8
    assert budget.affordable(5, 0.1001, began) == 5
    assert budget.affordable(20, 0.001, began) == 1  # never none
    assert TimeBudget(None).affordable(20, 0.001, 0.0) == 20


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


def test_describing_and_working_leave_the_threads_of_the_program_around_them_as_they_were():
    def counts():
        return [library["num_threads"] for library in threadpoolctl.threadpool_info()], cv2.getNumThreads()

    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    try:
        found = counts()
        descriptor = small_describer(threads=2).describe(image)
        Reranker(small_describer(threads=2).config).scores(descriptor, [descriptor] * 3)
        assert counts() == found
        pool = workers(3)
        assert pool.map(lambda _: cv2.getNumThreads(), range(6)) == [1] * 6
        assert workers(1).map(lambda _: cv2.getNumThreads(), range(2)) == [1, 1]
        with pytest.raises(ZeroDivisionError):
            pool.map(lambda part: 1 // part, [1, 0])
        assert counts() == found
    finally:
        cv2.setNumThreads(before)


@given(length=st.integers(1, 500), parts=st.integers(1, 9), align=st.sampled_from([1, 16, 64]))
def test_spans_cover_everything_once(length, parts, align):
    cut = spans(length, parts, align)
    assert [n for a, b in cut for n in range(a, b)] == list(range(length))
    assert len(cut) <= parts
    assert all(a % align == 0 for a, _ in cut)


def test_a_robot_imports_neither_torch_nor_a_compiler(tmp_path):
    """A fresh process that describes, stores, re-ranks and verifies; the second start finds what the first compiled."""
    program = """
import sys
import threading
import numpy as np
from pnv_core import Config, Describer, Frame, PlaceRecognizer, load_describer

recognizer = PlaceRecognizer(load_describer(min_interval_s=0.0, min_change=0.0, exclude_recent_s=10.0))
for second in (0, 60):
    image = np.random.default_rng(1).integers(0, 256, (20, 26, 3), np.uint8).repeat(24, 0).repeat(24, 1)
    closures = recognizer.process(Frame(second * 10**9, "front", image))
assert closures[0].evidence.local_inliers > 20
print([name for name in ("torch", "numba", "llvmlite", "onnxruntime", "scipy", "nncf") if name in sys.modules])
"""
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    listings = []
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
        assert done.stdout.strip() == "[]", done.stderr
        listings.append(sorted((p.name, p.stat().st_mtime_ns) for p in tmp_path.rglob("*") if p.is_file()))
    assert listings[0]
    assert listings[0] == listings[1]


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7])
def test_usac_finds_nearly_the_inliers_of_ransac_and_the_same_ones_each_time(share):
    """Judged by OpenCV's own RANSAC over 40 pairs of 130 matches, a share of them on one similarity with noise."""
    rng = np.random.default_rng(11)
    ransac, usac = [], []
    for _ in range(40):
        source = rng.uniform(0, 380, (130, 2)).astype(np.float32)
        target = rng.uniform(0, 280, (130, 2)).astype(np.float32)
        true = int(share * 130)
        target[:true] = source[:true] * 0.95 + 5 + rng.normal(0, 4, (true, 2))
        _, mask = cv2.findHomography(source, target, cv2.RANSAC, 24.0)
        found = usac_inliers(source, target, 24.0)
        assert np.array_equal(found, usac_inliers(source, target, 24.0))
        ransac.append(int(mask.sum()))
        usac.append(int(found.sum()))
    if share:
        assert np.mean(usac) == pytest.approx(np.mean(ransac), rel=0.05)
    else:  # what agrees by chance speaks for nothing
        assert np.mean(usac) <= np.mean(ransac)


def test_threads_that_work_alone_at_once_put_opencvs_number_back_together():
    """Entered one after another and left in the same order, as two threads do."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    try:
        first, second = alone(), alone()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert cv2.getNumThreads() == 1
        second.__exit__(None, None, None)
        assert cv2.getNumThreads() == 3
    finally:
        cv2.setNumThreads(before)


@pytest.mark.parametrize(("threads", "verified", "parts"), [
    (1, True, (1, 1)), (2, True, (1, 1)), (3, True, (2, 1)), (4, True, (2, 2)), (4, False, (4, 1)), (1, False, (1, 1)),
])  # fmt: skip
def test_network_and_local_features_share_the_threads(threads, verified, parts):
    assert shared(threads, verified) == parts


def test_what_runs_beside_waits_for_no_parts():
    """A part that waits for what runs beside it would never end in one pool."""
    pool = workers(2)
    waiting = threading.Event()
    beside = pool.beside(lambda: waiting.set() or 7)
    assert pool.map(lambda _: waiting.wait(20), range(4)) == [True] * 4
    assert beside() == 7

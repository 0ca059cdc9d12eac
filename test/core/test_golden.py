"""The whole recogniser against the outputs of the authors' code and their exact float64 twins.

K clusters, D = 128 dimensions; every golden file covers ten photographs and patch sizes 2, 5, 8. They lie beside the
project, not in it; test/golden holds a smaller set that every clone has.
"""

import importlib.util
import json
from pathlib import Path

import cv2
import faiss
import numpy as np
import pytest
import torch
from PIL import Image

from pnv_core.config import Config
from pnv_core.describe.checkpoints import load_checkpoint
from pnv_core.describe.describer import Describer
from pnv_core.describe.netvlad import NetVLAD
from pnv_core.describe.patches import patch_descriptors, patch_vlads
from pnv_core.types import PatchGrid
from pnv_core.verify.matching import mutual_nearest
from pnv_core.verify.spatial import fused_score, ransac_score, rapid_spatial_score

if not (Path(__file__).parents[3] / "shared").is_dir():
    pytest.skip("no ../shared beside the project; test/golden is checked all the same", allow_module_level=True)

SIZES = (2, 5, 8)
DIGESTS = {
    16: "e9d5e29f6e5214545109cab0fe3a38510bdcb3fe7e9263cc2ef351daea63870d",
    64: "1cedb3d60a0e2d7a26a7717e83dffea3c51eaade1e445f43582de0baf12f5046",
}
SETS = [(16, 320, 240), (16, 640, 480), (64, 320, 240), (64, 640, 480)]
SAME_PLACE_PAIRS = [(0, 1), (2, 3)]


@pytest.fixture(scope="module")
def golden(shared):
    folder = shared / "golden"
    return lambda name: np.load(folder / f"{name}.npz")


@pytest.fixture(scope="module")
def checkpoint(shared, tmp_path_factory):
    """The full-size synthetic checkpoint of K clusters, regenerated and its digest checked."""
    spec = importlib.util.spec_from_file_location("make_checkpoint", shared / "checkpoint" / "make_checkpoint.py")
    maker = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(maker)
    # calibration.npz lies with the golden arrays where the checkpoint folder has none
    if not (shared / "checkpoint" / "calibration.npz").exists():
        maker.HERE = str(shared / "golden")
    folder = tmp_path_factory.mktemp("checkpoints")
    made = {}

    def path(clusters):
        if clusters not in made:
            made[clusters] = folder / f"synth_K{clusters}.pth.tar"
            assert maker.save(str(made[clusters]), clusters, 128, "float64") == DIGESTS[clusters]
        return made[clusters]

    return path


@pytest.fixture(scope="module")
def photos(shared):
    names = [f"{name}.png" if not name.endswith(".png") else name for name in _photo_names(shared)]
    return [np.asarray(Image.open(shared / "golden" / "images" / name)) for name in names]


def _photo_names(shared):
    with np.load(shared / "golden" / "K16_320x240.npz") as arrays:
        return [str(name) for name in arrays["names"]]


@pytest.fixture(scope="module")
def described(checkpoint, photos):
    """(K, width, height) -> describer and the descriptors of the first photographs, made once per backend."""
    cache = {}

    def make(clusters, width, height, count, backend="openvino"):
        key = (clusters, width, height, backend)
        if key not in cache:
            config = Config.make(
                backend=backend,
                image_width=width,
                image_height=height,
                patch_sizes=SIZES,
                patch_weights=(0.45, 0.15, 0.4),
            )
            cache[key] = Describer(load_checkpoint(checkpoint(clusters)), config), []
        describer, done = cache[key]
        while len(done) < count:
            done.append(describer.describe(photos[len(done)]))
        return describer, done

    return make


def grid_of(descriptors, size, width, height):
    return PatchGrid(size, height // 16 - size + 1, width // 16 - size + 1, descriptors)


def test_resizing_equals_the_reference_to_the_bit(shared, photos):
    from pnv_core.describe.describer import resized

    for width, height in ((320, 240), (640, 480)):
        expected = np.asarray(Image.open(shared / "golden" / "images" / f"resized_china_{width}x{height}.png"))
        assert np.array_equal(resized(photos[0], width, height), expected)


@pytest.mark.parametrize("backend", ["openvino", "torch"])
@pytest.mark.parametrize(("width", "height"), [(320, 240), (640, 480)])
def test_encoder_features_equal_the_reference(golden, described, photos, width, height, backend):
    from pnv_core.describe.describer import resized

    arrays = golden(f"K16_{width}x{height}")
    describer, _ = described(16, width, height, 0, backend)
    full = describer.maps(resized(photos[0], width, height))[0]
    expected = arrays["feat_full_china"]
    assert np.abs(full - expected).max() <= 1e-4 * np.abs(expected).max()


@pytest.mark.parametrize("backend", ["openvino", "torch"])
@pytest.mark.parametrize(("clusters", "width", "height"), SETS)
def test_descriptors_equal_the_exact_arrays(golden, described, clusters, width, height, backend):
    arrays = golden(f"K{clusters}_{width}x{height}")
    _, descriptors = described(clusters, width, height, 2, backend)
    for image in (0, 1):
        assert np.abs(descriptors[image].global_vector - arrays["vlad_global"][image]).max() < 1e-5
        for size, grid in zip(SIZES, descriptors[image].patches, strict=True):
            columns = arrays[f"patch_sub_cols_p{size}"]
            assert np.abs(grid.descriptors[columns].T - arrays[f"patch_exact_sub_p{size}"][image]).max() < 1e-5
            if len(arrays.get(f"patch_exact_full_p{size}", ())) > image:
                assert np.abs(grid.descriptors.T - arrays[f"patch_exact_full_p{size}"][image]).max() < 1e-5


@pytest.mark.parametrize(("clusters", "width", "height"), SETS)
def test_keypoints_and_grids_equal_the_reference(golden, clusters, width, height):
    arrays = golden(f"K{clusters}_{width}x{height}")
    for size in SIZES:
        grid = grid_of(np.empty((0, 128), np.float32), size, width, height)
        assert np.array_equal(grid.keypoints().T, arrays[f"keypoints_p{size}"])
        assert np.array_equal(grid.indices().T, arrays[f"indices_p{size}"])


@pytest.mark.parametrize("clusters", [16, 64])
def test_matches_and_scores_of_all_pairs_equal_the_exact_ones(golden, described, clusters):
    """At 320x240 the golden file holds matches and scores of all 100 ordered pairs from exact descriptors."""
    arrays = golden(f"K{clusters}_320x240")
    _, descriptors = described(clusters, 320, 240, 10)
    differing = 0
    for s, size in enumerate(SIZES):
        offsets = arrays[
            f"mnn_offsets_exact_p{size}" if f"mnn_offsets_exact_p{size}" in arrays else f"mnn_offsets_p{size}_exact"
        ]
        db, q = (arrays[f"mnn_{side}_p{size}_exact"] for side in ("db", "q"))
        for i in range(10):
            for j in range(10):
                query, reference = descriptors[i].patches[s], descriptors[j].patches[s]
                matches = mutual_nearest(query.descriptors, reference.descriptors)
                part = slice(offsets[10 * i + j], offsets[10 * i + j + 1])
                expected = set(zip(q[part].tolist(), db[part].tolist(), strict=True))
                given = set(zip(matches[0].tolist(), matches[1].tolist(), strict=True))
                similarity = query.descriptors.astype(np.float64) @ reference.descriptors.astype(np.float64).T
                for patch_q, patch_db in given ^ expected:  # only where best and second best are as good as equal
                    row, column = np.sort(similarity[patch_q]), np.sort(similarity[:, patch_db])
                    assert min(row[-1] - row[-2], column[-1] - column[-2]) < 1e-5
                differing += len(given ^ expected)
                if given == expected:
                    extent = (query.cols - 1) ** 2 + (query.rows - 1) ** 2
                    assert rapid_spatial_score(query, reference, matches) == pytest.approx(
                        -arrays["spatial_exact"][s, i, j] / extent, abs=1e-6
                    )
    assert differing <= 10


def test_ransac_inliers_lie_within_the_spread_of_opencv_versions(shared, golden):
    """On the stored matches, so that only RANSAC itself is compared; OpenCV differs between versions."""
    versions = json.loads((shared / "golden" / "ransac_by_opencv.json").read_text())
    for name, width, height in (("K16_320x240", 320, 240), ("K16_640x480", 640, 480)):
        counts = np.array([v[name] for v in versions.values()])  # (versions, 3, 10, 10)
        low, high = counts.min(0), counts.max(0)
        arrays = golden(name)
        for s, size in enumerate(SIZES):
            offsets, db, q = (arrays[f"mnn_{part}_p{size}"] for part in ("offsets", "db", "q"))
            grid = grid_of(np.empty((0, 128), np.float32), size, width, height)
            for t in range(100):
                part = slice(offsets[t], offsets[t + 1])
                score, inlier = ransac_score(grid, grid, (q[part].astype(np.int64), db[part].astype(np.int64)))
                assert low[s, t // 10, t % 10] <= inlier.sum() <= high[s, t // 10, t % 10], (
                    name,
                    size,
                    t,
                    cv2.__version__,
                )
                assert score == inlier.sum() / (grid.rows * grid.cols)


@pytest.mark.parametrize(("clusters", "width", "height"), SETS)
def test_nearest_patches_equal_the_reference_where_its_gap_is_clear(golden, described, clusters, width, height):
    """On the reference's own descriptors where they are stored in full; ours differ from them on purpose."""
    arrays = golden(f"K{clusters}_{width}x{height}")
    checked = 0
    for size in SIZES:
        full, images = arrays[f"patch_full_p{size}"], list(arrays[f"patch_full_images_p{size}"])
        for i, j in [*SAME_PLACE_PAIRS, (0, 2)]:
            if i not in images or j not in images:
                continue
            query, reference = full[images.index(i)].T, full[images.index(j)].T
            forward, backward = arrays[f"fw_p{size}_q{i}_d{j}"], arrays[f"bw_p{size}_q{i}_d{j}"]
            clear = arrays[f"fwgap_p{size}_q{i}_d{j}"] > 1e-5
            expected = {(int(forward[d]), d) for d in range(len(forward)) if backward[forward[d]] == d}
            q, r = mutual_nearest(query, reference)
            given = set(zip(q.tolist(), r.tolist(), strict=True))
            gap_back = arrays[f"bwgap_p{size}_q{i}_d{j}"] > 1e-5
            assert all(not clear[d] or not gap_back[p] for p, d in given ^ expected)
            checked += len(expected)
    assert checked > 0 or (clusters, width) == (64, 640)


@pytest.mark.parametrize("clusters", [16, 64])
def test_retrieval_ranking_equals_the_reference(golden, described, clusters):
    arrays = golden(f"K{clusters}_320x240")
    _, descriptors = described(clusters, 320, 240, 10)
    vectors = np.stack([d.global_vector for d in descriptors])
    index = faiss.IndexFlatIP(vectors.shape[1])
    index.add(vectors[arrays["ds_db"]])
    _, ranking = index.search(vectors[arrays["ds_q"]], len(arrays["ds_db"]))
    assert np.array_equal(ranking, arrays["ds_pred"])


@pytest.mark.parametrize("clusters", [16, 64])
def test_fused_rapid_scores_equal_the_exact_ones(golden, clusters):
    """The convex combination over patch sizes, of the reference's own per-size scores."""
    arrays = golden(f"K{clusters}_320x240")
    for i in range(10):
        for j in range(10):
            given = fused_score([-arrays["spatial_exact"][s, i, j] for s in range(3)], arrays["weights"])
            assert given == pytest.approx(arrays["fused_spatial_exact"][i, j], rel=1e-9)


def assert_like_float32_integral(given, reference):
    """(D, n) columns agree with the reference's up to the cancellation of its float32 integral map."""
    cosine = (np.asarray(given, np.float64) * reference).sum(0)
    assert np.median(1 - cosine) < 1e-6
    assert (1 - cosine).max() < 1e-3


def exact_vlads(stage, size):
    """The definition in float64, window by window, for image 0: (n, K * C)."""
    x = stage["feat"][0].astype(np.float64)
    x /= np.linalg.norm(x, axis=0)
    logits = np.einsum("kc,chw->khw", stage["conv_weight"][:, :, 0, 0].astype(np.float64), x)
    weights = np.exp(logits - logits.max(0))
    weights /= weights.sum(0)
    residuals = weights[:, None] * (x[None] - stage["centroids"].astype(np.float64)[:, :, None, None])
    rows = []
    for i in range(x.shape[1] - size + 1):
        for j in range(x.shape[2] - size + 1):
            sums = residuals[:, :, i : i + size, j : j + size].sum((2, 3))
            sums /= np.linalg.norm(sums, axis=1, keepdims=True)
            rows.append(sums.ravel() / np.linalg.norm(sums))
    return np.stack(rows)


def test_every_stage_equals_the_reference_without_a_network(golden):
    stage = golden("stages")
    feat = torch.from_numpy(stage["feat"])
    k, c = stage["centroids"].shape
    netvlad = NetVLAD(k, c)
    netvlad.centroids.data = torch.from_numpy(stage["centroids"])
    netvlad.assignment.data = torch.from_numpy(stage["conv_weight"]).view(k, c)
    with torch.inference_mode():
        x, weights = netvlad.soft_assign(feat)
        h, w = feat.shape[2:]
        assert np.allclose(x[0].view(c, h, w), stage["feat_normalised_img0"], atol=1e-6)
        assert np.allclose(weights.view(2, k, h, w), stage["soft_assign"], atol=1e-6)
        assert np.allclose(netvlad.vlad(x, weights), stage["vlad_global"], atol=1e-6)
        projection = torch.from_numpy(stage["wpca_weight"]).flatten(1)
        bias = torch.from_numpy(stage["wpca_bias"])
        whole = torch.nn.functional.normalize(torch.from_numpy(stage["vlad_global"]) @ projection.T + bias, dim=1)
        assert np.allclose(whole, stage["vlad_global_pca"], atol=1e-5)
        grids = []
        for image in range(2):
            arrays = patch_descriptors(
                x[image], weights[image], netvlad.centroids, projection, bias, (h, w), SIZES, (1, 1, 1)
            )
            grids.append([PatchGrid(p, h - p + 1, w - p + 1, a.numpy()) for p, a in zip(SIZES, arrays, strict=True)])
            for size, array in zip(SIZES, arrays, strict=True):
                assert_like_float32_integral(array.T, stage[f"patch_pca_p{size}"][image])
        for size in SIZES:
            vlads = patch_vlads(x[0], weights[0], netvlad.centroids, (h, w), size)
            assert_like_float32_integral(vlads.T, stage[f"patch_img0_p{size}"])
            assert np.allclose(vlads, exact_vlads(stage, size), atol=1e-6)
        for size in (2, 5):
            strided = patch_descriptors(x[0], weights[0], netvlad.centroids, projection, bias, (h, w), [size], [2])[0]
            assert_like_float32_integral(strided.T, stage[f"patch_pca_p{size}_stride2"][0])
    for s, size in enumerate(SIZES):
        query, reference = grids[0][s], grids[1][s]
        assert np.array_equal(query.keypoints().T, stage[f"keypoints_p{size}"])
        q, r = mutual_nearest(query.descriptors, reference.descriptors)
        assert np.array_equal(q, stage[f"mutual_q_p{size}"])
        assert np.array_equal(r, stage[f"mutual_db_p{size}"])
        extent = (query.cols - 1) ** 2 + (query.rows - 1) ** 2
        assert rapid_spatial_score(query, reference, (q, r)) == pytest.approx(-stage["spatial"][s] / extent, abs=1e-6)


def test_every_matching_case_scores_as_the_reference(shared, golden):
    """Explicit correspondences on the p = 5 grid of 640x480: identity, shifts, collinear, one match, none ..."""
    cases = golden("cases")
    grid = grid_of(np.empty((0, 128), np.float32), 5, 640, 480)
    patches, extent = grid.rows * grid.cols, (grid.cols - 1) ** 2 + (grid.rows - 1) ** 2
    names = sorted(
        {key[: -len("_scores")] for key in cases.files if key.endswith("_scores") and not key.startswith("zs_")}
    )
    assert len(names) >= 10
    for name in names:
        matches = cases[f"{name}_q"].astype(np.int64), cases[f"{name}_db"].astype(np.int64)
        ransac, rapid, _ = cases[f"{name}_scores"]
        assert rapid_spatial_score(grid, grid, matches) == pytest.approx(-rapid / extent, abs=1e-6), name
        given, inlier = ransac_score(grid, grid, matches)
        assert 0.0 <= given <= 1.0
        assert inlier.shape == matches[0].shape
        assert given == pytest.approx(
            -ransac, abs=(2 if "noise" in name or "random" in name else 0) / patches + 1e-12
        ), name

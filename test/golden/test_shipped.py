"""The recogniser equals exact Patch-NetVLAD: the file of this folder, written by `make` with the float64 `reference`.

The larger golden set, outputs of the authors' own code, is in test/core/test_golden.py where the project has it.
"""

import faiss
import numpy as np
import pytest
import torch

from pnv_core import Config, PatchGrid, load_describer
from pnv_core.verify.matching import mutual_nearest
from pnv_core.verify.reranker import Reranker
from pnv_core.verify.spatial import ransac_score, rapid_spatial_score
from test.golden import reference
from test.golden.make import CLUSTERS, DIM, FILE, HEIGHT, SIZES, WIDTH

WEIGHTS = (0.45, 0.15, 0.4)
GEOMETRY = {"image_width": WIDTH, "image_height": HEIGHT, "patch_sizes": SIZES, "patch_weights": WEIGHTS}


@pytest.fixture(scope="module")
def golden():
    with np.load(FILE) as arrays:
        return dict(arrays)


@pytest.fixture(scope="module")
def weights(golden):
    return reference.random_weights(CLUSTERS, DIM) | {k: v for k, v in golden.items() if k.endswith("bias")}


@pytest.fixture(scope="module")
def checkpoint(weights, tmp_path_factory):
    """An official checkpoint of full size, its projection in double precision as published ones have it."""
    path = tmp_path_factory.mktemp("golden") / "random.pth.tar"
    state = {name: torch.from_numpy(array) for name, array in weights.items()}
    state |= {name: tensor.double() for name, tensor in state.items() if name.startswith("WPCA")}
    torch.save({"num_pcs": DIM, "state_dict": state}, path)
    return path


@pytest.fixture(scope="module")
def described(golden, checkpoint):
    describer = load_describer(checkpoint, **GEOMETRY)
    return [describer.describe(image) for image in golden["images"]]


def grids(size):
    return HEIGHT // 16 - size + 1, WIDTH // 16 - size + 1


def pairs_of(golden, size, query, reference_):
    ends = np.concatenate([[0], golden[f"counts_{size}"].ravel().cumsum()])
    at = len(golden["images"]) * query + reference_
    return golden[f"pairs_{size}"][ends[at] : ends[at + 1]].astype(np.int64)


def test_the_shipped_arrays_are_what_the_reference_computes(golden, weights):
    """One picture anew; the file is no older than the code that writes it."""
    (maps,) = reference.features(weights, golden["images"][3:])
    parts = reference.residuals(weights, maps)
    whole = reference.projected(weights, reference.vlad(parts.sum((2, 3)))[None])[0]
    assert np.abs(whole - golden["global"][3]).max() < 1e-6
    for size in SIZES:
        rows = reference.projected(weights, reference.window_vlads(parts, size))
        assert np.abs(rows - golden[f"patches_{size}"][3]).max() < 1e-6


def test_global_vectors_and_patches_equal_the_exact_ones(golden, described):
    for number, descriptor in enumerate(described):
        assert np.abs(descriptor.global_vector - golden["global"][number]).max() < 1e-5
        for size, grid in zip(SIZES, descriptor.patches, strict=True):
            assert (grid.size, grid.rows, grid.cols) == (size, *grids(size))
            assert np.abs(grid.descriptors - golden[f"patches_{size}"][number]).max() < 1e-5


def test_matches_and_rapid_scores_of_all_pairs_equal_the_exact_ones(golden, described):
    differing = 0
    for s, size in enumerate(SIZES):
        for i, query in enumerate(described):
            for j, other in enumerate(described):
                q, r = query.patches[s], other.patches[s]
                matches = mutual_nearest(q.descriptors, r.descriptors)
                expected = pairs_of(golden, size, i, j)
                given = set(zip(*(m.tolist() for m in matches), strict=True))
                similarity = golden[f"patches_{size}"][i].astype(np.float64) @ golden[f"patches_{size}"][j].T
                for patch_q, patch_r in given ^ set(map(tuple, expected.tolist())):  # only where two are as good
                    row, column = np.sort(similarity[patch_q]), np.sort(similarity[:, patch_r])
                    assert min(row[-1] - row[-2], column[-1] - column[-2]) < 1e-5
                    differing += 1
                exact = rapid_spatial_score(q, r, (expected[:, 0], expected[:, 1]))
                assert exact == pytest.approx(golden[f"rapid_{size}"][i, j], abs=1e-6)
    assert differing <= 2


def test_retrieval_finds_the_other_view_first(golden, described):
    vectors = np.stack([d.global_vector for d in described])
    index = faiss.IndexFlatIP(DIM)
    index.add(vectors)
    expected = np.argsort(-(golden["global"].astype(np.float64) @ golden["global"].T), axis=1, kind="stable")
    assert np.array_equal(index.search(vectors, 4)[1], expected)
    assert expected[:, 1].tolist() == [1, 0, 3, 2]


@pytest.mark.parametrize("scorer", ["ransac", "rapid"])
def test_fused_scores_are_the_convex_combination_over_patch_sizes(golden, described, scorer):
    config = Config.make(**GEOMETRY, patch_strides=(1, 1, 1), scorer=scorer)
    for i, j in ((0, 0), (0, 1), (2, 3), (0, 2)):
        result = Reranker(config).score(described[i], described[j])
        if scorer == "rapid":
            expected = sum(w * golden[f"rapid_{size}"][i, j] for w, size in zip(WEIGHTS, SIZES, strict=True))
        else:  # inliers as a share of the query's patches
            shares = [m.inlier.sum() / np.prod(grids(m.size)) for m in result.matches]
            expected = float(np.dot(WEIGHTS, shares))
        assert result.score == pytest.approx(expected, abs=1e-6)
        assert i != j or result.score == pytest.approx(1.0)


def test_keypoints_are_the_middles_of_the_receptive_fields():
    """Patch-NetVLAD's receptive box: cell (col, row) from 16 col - 90 to 16 col + 105, truncated to whole pixels."""
    for size in SIZES:
        rows, cols = grids(size)
        grid = PatchGrid(size, rows, cols, np.empty((0, DIM), np.float32))
        expected = [((16 * c - 90 + 16 * (c + size - 1) + 105) // 2, (16 * r - 90 + 16 * (r + size - 1) + 105) // 2)
                    for r in range(rows) for c in range(cols)]  # fmt: skip
        assert grid.keypoints().tolist() == [list(point) for point in expected]
        assert grid.indices().tolist() == [[c, r] for r in range(rows) for c in range(cols)]


def test_ransac_counts_what_one_homography_explains():
    """Cases whose count needs no random numbers: all, none and too few."""
    rows, cols = 26, 36
    grid = PatchGrid(5, rows, cols, np.empty((0, DIM), np.float32))
    everything = np.arange(rows * cols)
    row, col = np.divmod(everything, cols)
    inside = (row < rows - 4) & (col < cols - 7)
    line = everything[row == 3]
    for query, other, inliers in (
        (everything, everything, rows * cols),
        (everything[inside], (everything + 4 * cols + 7)[inside], inside.sum()),  # a shift
        (line, line, 0),  # points of a line determine none
        (everything[:3], everything[:3], 0),
        (everything[:0], everything[:0], 0),
    ):
        score, inlier = ransac_score(grid, grid, (query, other))
        assert inlier.sum() == inliers
        assert score == inliers / (rows * cols)

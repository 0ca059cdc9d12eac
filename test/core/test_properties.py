"""Properties of the mathematics, against brute force in float64."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pnv_core.describe.netvlad import NetVLAD, alpha_rule
from pnv_core.describe.patches import patch_descriptors, window_sums
from pnv_core.types import PatchGrid
from pnv_core.verify.matching import mutual_nearest
from pnv_core.verify.reranker import Reranker
from pnv_core.verify.spatial import ransac_score, rapid_spatial_score
from test.core.small import HEIGHT, WIDTH, noise_image, small_describer


@given(h=st.integers(1, 12), w=st.integers(1, 12), size=st.integers(1, 12), seed=st.integers(0, 99))
def test_window_sums_are_the_sums_over_windows(h, w, size, seed):
    if size > min(h, w):
        return
    maps = torch.from_numpy(np.random.default_rng(seed).normal(size=(2, h, w)))
    sums = window_sums(maps, [size])[size].numpy()
    for i in range(h - size + 1):
        for j in range(w - size + 1):
            assert np.allclose(sums[:, i, j], maps[:, i : i + size, j : j + size].sum((1, 2)), atol=1e-12)


@settings(deadline=None, max_examples=20)
@given(
    size=st.integers(1, 5), stride=st.integers(1, 3), seed=st.integers(0, 99), peak=st.sampled_from([1.0, 50.0, 400.0])
)
def test_patch_descriptors_are_the_projected_window_vlads(size, stride, seed, peak):
    """The definition in float64: window means of residuals, intra-normalised, flattened, normalised, projected."""
    rng = np.random.default_rng(seed)
    k, c, d, h, w = 3, 8, 6, 6, 7
    x = rng.normal(size=(c, h * w))
    x /= np.linalg.norm(x, axis=0)
    centroids, projection, bias = rng.normal(size=(k, c)) * 0.3, rng.normal(size=(d, k * c)), rng.normal(size=d) * 0.1
    logits = peak * centroids @ x
    weights = np.exp(logits - logits.max(0))
    weights /= weights.sum(0)
    as_tensors = [torch.from_numpy(a.astype(np.float32)) for a in (x, weights, centroids, projection, bias)]
    given_rows = patch_descriptors(*as_tensors, (h, w), [size], [stride])[0].numpy()
    x32, w32 = (as_tensors[i].double().numpy() for i in (0, 1))
    residuals = (w32[:, None] * (x32[None] - as_tensors[2].double().numpy()[:, :, None])).reshape(k, c, h, w)
    row = 0
    for i in range(0, h - size + 1, stride):
        for j in range(0, w - size + 1, stride):
            sums = residuals[:, :, i : i + size, j : j + size].mean((2, 3))
            vlad = (sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)).ravel()
            vlad = projection @ (vlad / np.maximum(np.linalg.norm(vlad), 1e-12)) + bias
            assert np.abs(given_rows[row] - vlad / np.linalg.norm(vlad)).max() < 2e-5
            row += 1
    assert row == len(given_rows)


def test_a_patch_larger_than_the_map_is_refused_by_name():
    with pytest.raises(ValueError, match=r"patch size 7 exceeds the feature map of 5 x 6 cells; allowed: 1 to 5"):
        patch_descriptors(
            torch.zeros(4, 30),
            torch.zeros(2, 30),
            torch.zeros(2, 4),
            torch.zeros(3, 8),
            torch.zeros(3),
            (5, 6),
            [7],
            [1],
        )


@settings(deadline=None)
@given(n=st.integers(0, 12), m=st.integers(0, 12), seed=st.integers(0, 999))
def test_mutual_nearest_agrees_with_two_loops(n, m, seed):
    rng = np.random.default_rng(seed)
    a, b = (rng.normal(size=(count, 4)).astype(np.float32) for count in (n, m))
    a /= np.linalg.norm(a, axis=1, keepdims=True) if n else 1
    b /= np.linalg.norm(b, axis=1, keepdims=True) if m else 1
    expected = set()
    for i in range(n):
        for j in range(m):
            if all(a[i] @ b[j] >= a[i] @ other for other in b) and all(a[i] @ b[j] >= other @ b[j] for other in a):
                expected.add((i, j))
    assert set(zip(*(side.tolist() for side in mutual_nearest(a, b)), strict=True)) == expected


def test_patches_match_themselves_and_masked_ones_match_nothing():
    rows = np.eye(6, dtype=np.float32)
    rows[4] = 0.0
    q, r = mutual_nearest(rows, rows)
    assert q.tolist() == r.tolist() == [0, 1, 2, 3, 5]


@settings(deadline=None)
@given(seed=st.integers(0, 999), count=st.integers(0, 40), stride=st.integers(1, 2))
def test_spatial_scores_of_any_matches_lie_between_0_and_1(seed, count, stride):
    rng = np.random.default_rng(seed)
    grid = PatchGrid(2, 6, 8, np.empty((48, 0), np.float32), stride)
    matches = rng.permutation(48)[:count], rng.permutation(48)[:count]
    assert 0.0 <= rapid_spatial_score(grid, grid, matches) <= 1.0
    score, inlier = ransac_score(grid, grid, matches)
    assert 0.0 <= score <= 1.0
    assert inlier.shape == (count,)


@pytest.mark.parametrize("scorer", ["usac", "ransac", "rapid"])
def test_an_image_scores_1_against_itself_and_more_than_against_another(scorer):
    describer = small_describer(scorer=scorer)
    one, other = describer.describe(noise_image(1)), describer.describe(noise_image(2))
    reranker = Reranker(describer.config)
    assert reranker.score(one, one).score == pytest.approx(1.0)
    assert reranker.score(one, other).score < 0.5


@pytest.mark.parametrize("scorer", ["usac", "ransac", "rapid"])
@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_blank_image_gives_finite_numbers_and_no_texture(scorer, level):
    describer = small_describer(scorer=scorer)
    blank = describer.describe(np.full((HEIGHT, WIDTH, 3), level, np.uint8))
    assert blank.texture == 0.0
    assert np.isfinite(blank.global_vector).all()
    assert all(np.isfinite(grid.descriptors).all() for grid in blank.patches)
    textured = describer.describe(noise_image(3))
    assert textured.texture > 0.9
    for pair in ((blank, blank), (blank, textured), (textured, blank)):
        assert 0.0 <= Reranker(describer.config).score(*pair).score <= 1.0


def test_a_masked_region_does_not_change_the_descriptor():
    """What lies well under the mask may look like anything; cells at its edge see a little of it."""
    describer = small_describer()
    image, other = noise_image(4), noise_image(4)
    other[96:] = noise_image(5)[96:]
    valid = np.ones(image.shape[:2], bool)
    valid[64:] = False
    a, b = describer.describe(image, valid), describer.describe(other, valid)
    assert float(a.global_vector @ b.global_vector) > 0.999
    free_a, free_b = describer.describe(image), describer.describe(other)
    assert float(free_a.global_vector @ free_b.global_vector) < 0.99


def test_texture_counts_what_the_mask_leaves_only():
    """A blank wall seen above a textured bonnet is a blank wall."""
    image = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    image[96:] = noise_image(5)[96:]
    valid = np.ones(image.shape[:2], bool)
    valid[96:] = False
    describer = small_describer()
    assert describer.describe(image).texture > 0.3
    assert describer.describe(image, valid).texture == 0.0


def test_alpha_gives_the_second_cluster_a_hundredth_of_the_first_on_average():
    """NetVLAD appendix: the mean gap of the two largest logits is -ln 0.01."""
    rng = torch.Generator().manual_seed(3)
    centroids = torch.randn(5, 16, generator=rng)
    samples = torch.nn.functional.normalize(torch.randn(400, 16, generator=rng), dim=1)
    logits = samples @ alpha_rule(centroids, samples).T
    top = logits.topk(2, dim=1).values
    assert float((top[:, 0] - top[:, 1]).mean()) == pytest.approx(np.log(100.0), rel=1e-4)


def test_whole_image_vlad_does_not_depend_on_where_things_are():
    rng = torch.Generator().manual_seed(1)
    netvlad = NetVLAD(3, 8)
    netvlad.centroids.data = torch.randn(3, 8, generator=rng)
    netvlad.assignment.data = torch.randn(3, 8, generator=rng)
    features = torch.randn(1, 8, 4, 5, generator=rng)
    shuffled = features.flatten(2)[..., torch.randperm(20, generator=rng)].view_as(features)
    assert torch.allclose(netvlad(features), netvlad(shuffled), atol=1e-6)

"""The scale at which a candidate shows the scene; oracle: matches made by a known motion, and the formula on paper."""

from dataclasses import replace
from math import exp, log

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pnv_core.config import PRESETS, Config
from pnv_core.types import PatchMatches
from pnv_core.verify.reranker import Reranker
from pnv_core.verify.spatial import scale_change
from test.core.small import noise_image, small_describer


def seen(scale: float, sideways: float = 0.0, inliers: int = 40) -> PatchMatches:
    """Points at several depths, seen again `scale` times as large and after a step to the side."""
    rng = np.random.default_rng(2)
    query = rng.uniform(0, 400, (60, 2))
    depth = rng.uniform(1, 5, 60)
    reference = query * scale + 30
    reference[:, 0] += sideways / depth
    counts = np.arange(60) < inliers
    reference[~counts] = rng.uniform(0, 400, (60 - inliers, 2))
    numbers = np.arange(60)
    return PatchMatches(2, numbers, numbers, counts, query, reference)  # type: ignore[arg-type]


@given(scale=st.floats(0.5, 2.0), sideways=st.floats(-300, 300))
def test_a_step_forward_counts_and_a_step_aside_does_not(scale, sideways):
    expected = 1 - exp(-((log(scale) / 0.1) ** 2))
    assert scale_change([seen(scale, sideways)]) == pytest.approx(expected, abs=1e-9)


def test_sizes_are_averaged_and_a_size_without_inliers_knows_no_scale():
    both = scale_change([seen(1.05), seen(1.15)])
    assert both == pytest.approx(1 - exp(-(((log(1.05) + log(1.15)) / 2 / 0.1) ** 2)))
    assert scale_change([seen(1.0, inliers=5)]) > 0.999


def test_scores_of_one_image_stay_and_others_fall_by_the_weight_at_most():
    describer = small_describer()
    image = describer.describe(noise_image(1))
    plain = replace(describer.config, scale_weight=0.0)
    weighed = replace(describer.config, scale_weight=0.4)
    assert Reranker(weighed).score(image, image).score == Reranker(plain).score(image, image).score
    for seed in range(2, 6):
        other = describer.describe((0.6 * noise_image(1) + 0.4 * noise_image(seed)).astype(np.uint8))
        before, after = (Reranker(c).score(image, other) for c in (plain, weighed))
        assert 0.6 * before.score - 1e-12 <= after.score <= before.score
        assert after.per_size == before.per_size


def test_published_presets_keep_the_papers_score():
    assert Config().scale_weight > 0
    assert all(Config.make(preset).scale_weight == 0 for preset in PRESETS if preset != "default")

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from pnv_lab.training.losses import listwise_ap, multi_similarity, patch_contrast, triplet_ranking


def test_multi_similarity_equals_its_definition_pair_by_pair():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(12, 5))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    place = np.array([0, 0, 0, 1, 1, 2, 2, 2, 3, 3, 4, 4])
    unknown = {(0, 3), (3, 0), (5, 9), (9, 5)}
    total = []
    for i in range(12):
        positives = [j for j in range(12) if j != i and place[j] == place[i]]
        negatives = [j for j in range(12) if place[j] != place[i] and (i, j) not in unknown]
        similar = {j: x[i] @ x[j] for j in range(12)}
        pull = [j for j in positives if similar[j] < max(similar[n] for n in negatives) + 0.1]
        push = [j for j in negatives if similar[j] > min(similar[p] for p in positives) - 0.1]
        if pull or push:
            near = math.log1p(sum(math.exp(-2 * (similar[j] - 0.5)) for j in pull)) / 2
            total.append(near + math.log1p(sum(math.exp(40 * (similar[j] - 0.5)) for j in push)) / 40)
    positive = torch.from_numpy((place[:, None] == place) & ~np.eye(12, dtype=bool))
    negative = torch.from_numpy(place[:, None] != place)
    for i, j in unknown:
        negative[i, j] = False
    found = float(multi_similarity(torch.from_numpy(x), positive, negative))
    assert found == pytest.approx(np.mean(total), abs=1e-9)


def test_triplet_loss_takes_the_nearest_positive_and_every_violating_negative():
    query = torch.tensor([1.0, 0.0])
    positives = torch.tensor([[0.0, 1.0], [0.8, 0.6]])  # squared distances 2 and 0.4
    negatives = torch.tensor([[0.6, 0.8], [0.9, math.sqrt(0.19)], [-1.0, 0.0]])  # 0.8, 0.2 and 4
    assert float(triplet_ranking(query, positives, negatives)) == pytest.approx(0.4 + 0.1 - 0.2, abs=1e-6)


def test_patch_contrast_prefers_true_correspondence():
    torch.manual_seed(0)
    patches = F.normalize(torch.randn(30, 16), dim=1)
    places = torch.stack([torch.arange(30.0) * 3, torch.zeros(30), torch.zeros(30)], dim=1)
    right = patch_contrast(patches, patches, places, places, radius=1.5)
    wrong = patch_contrast(patches, patches.roll(1, 0), places, places, radius=1.5)
    assert right < 0.2 < 5 < wrong


def test_patch_contrast_without_overlap_is_zero_and_has_a_gradient():
    patches = F.normalize(torch.randn(6, 4), dim=1).requires_grad_(True)
    loss = patch_contrast(patches, patches, torch.zeros(6, 3), torch.full((6, 3), 1e4), radius=1.5)
    loss.backward()
    assert loss.item() == 0.0


def test_listwise_ap_is_average_precision_where_similarities_lie_on_the_bins():
    """Signs of 40 entries have similarities of 1, 0.95, ...; oracle: precision at every positive, counted."""
    x = np.random.default_rng(4).choice([-1.0, 1.0], (9, 40)) / np.sqrt(40)
    positive = np.zeros((9, 9), bool)
    positive[[0, 1, 0, 2, 3, 4], [1, 0, 2, 0, 4, 3]] = True
    negative = ~positive & ~np.eye(9, dtype=bool)
    negative[0, 5] = False  # not known: not ranked
    precisions = []
    for row in np.flatnonzero(positive.any(1)):
        similarity = np.round(x @ x[row], 6)
        before = [similarity >= similarity[j] for j in np.flatnonzero(positive[row])]
        ranked = positive[row] | negative[row]
        precisions.append(np.mean([(b & positive[row]).sum() / (b & ranked).sum() for b in before]))
    known = (torch.from_numpy(m) for m in (positive, negative))
    found = float(listwise_ap(torch.from_numpy(x), *known, bins=41))
    assert abs(found - (1 - np.mean(precisions))) < 1e-6

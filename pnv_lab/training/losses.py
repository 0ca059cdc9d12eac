"""Losses. B descriptors of D dimensions; masks are (B, B) bool; n patches of an image."""

import torch
import torch.nn.functional as F
from torch import Tensor

TRIPLET_MARGIN = 0.1  # NetVLAD section 4; the paper's training


def multi_similarity(
    descriptors: Tensor,
    positive: Tensor,
    negative: Tensor,
    alpha: float = 2.0,
    beta: float = 40.0,
    base: float = 0.5,
    margin: float = 0.1,
) -> Tensor:
    """Multi-similarity loss with its online mining (Wang et al., CVPR 2019, equations 9 to 12).

    A pair that is neither positive nor negative counts for nothing. 0 where nothing is mined.
    """
    similarity = descriptors @ descriptors.T
    hardest_negative = similarity.masked_fill(~negative, -2).amax(1, keepdim=True).detach()
    hardest_positive = similarity.masked_fill(~positive, 2).amin(1, keepdim=True).detach()
    pull = positive & (similarity < hardest_negative + margin)
    push = negative & (similarity > hardest_positive - margin)
    pulled = torch.where(pull, torch.exp(-alpha * (similarity - base)), 0.0).sum(1)
    pushed = torch.where(push, torch.exp(beta * (similarity - base)), 0.0).sum(1)
    anchors = pull.any(1) | push.any(1)
    loss = torch.log1p(pulled) / alpha + torch.log1p(pushed) / beta
    return loss[anchors].mean() if anchors.any() else similarity.sum() * 0.0


def listwise_ap(descriptors: Tensor, positive: Tensor, negative: Tensor, bins: int = 20) -> Tensor:
    """1 - the mean average precision of every row's ranking of the others, made smooth by soft binning of the
    similarities (Revaud et al., ICCV 2019, equations 4 to 8).

    A pair that is neither positive nor negative is not ranked. 0 where no row has a positive.
    """
    similarity = descriptors @ descriptors.T
    centres = torch.linspace(1, -1, bins, dtype=similarity.dtype, device=similarity.device)
    shares = F.relu(1 - (similarity[None] - centres[:, None, None]).abs() * (bins - 1) / 2)  # (bins, B, B)
    right, ranked = ((shares * pairs).sum(2) for pairs in (positive, positive | negative))  # (bins, B)
    precision = right.cumsum(0) / ranked.cumsum(0).clamp(min=1e-8)
    counts = positive.sum(1)
    average = (precision * right).sum(0) / counts.clamp(min=1)
    rows = counts > 0
    return 1 - average[rows].mean() if rows.any() else similarity.sum() * 0.0


def triplet_ranking(query: Tensor, positives: Tensor, negatives: Tensor, margin: float = TRIPLET_MARGIN) -> Tensor:
    """Weakly supervised triplet ranking loss (NetVLAD equation 7) of one query.

    query (D,), potential positives (P, D) of which the nearest counts, negatives (N, D); squared distances.
    """
    nearest = (query - positives).square().sum(1).min()
    return F.relu(nearest + margin - (query - negatives).square().sum(1)).sum()


def patch_contrast(
    query: Tensor,
    reference: Tensor,
    query_place: Tensor,
    reference_place: Tensor,
    radius: float,
    temperature: float = 0.07,
) -> Tensor:
    """InfoNCE between the patches of two views of one scene, both ways.

    query (n, D), reference (m, D) unit rows; places (n, 3), (m, 3) in the scene, in cells. A patch's positive is its
    mutually nearest patch if closer than half of `radius`; patches closer than `radius` are no negatives.
    0 without positives.
    """
    distance = torch.cdist(query_place, reference_place)
    closest, index = distance.min(1)
    mutual = distance.argmin(0)[index] == torch.arange(len(index), device=index.device)
    chosen = torch.nonzero(mutual & (closest < radius / 2)).flatten()
    if len(chosen) < 2:
        return (query.sum() + reference.sum()) * 0.0
    logits = query @ reference.T / temperature
    near = distance < radius
    near[chosen, index[chosen]] = False
    logits = logits.masked_fill(near, -1e4)
    forward = F.cross_entropy(logits[chosen], index[chosen])
    backward = F.cross_entropy(logits.T[index[chosen]], chosen)
    return (forward + backward) / 2

"""The state a training starts from: ImageNet trunk, principal neck, fitted vocabulary, learned whitening.

K clusters, C channels, W channels before the neck, D dimensions.
"""

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from pnv_core.describe.model_files import ModelInfo
from pnv_core.describe.netvlad import Projection, gem
from pnv_core.describe.patches import patch_vlads
from pnv_core.describe.torch_model import TorchModel, TorchTrunk
from pnv_core.describe.trunks.lite import lite_trunk
from pnv_core.errors import ModelError
from pnv_lab.fit import FitOptions, learned_whitening, local_samples, pca, projection_of, vocabulary
from pnv_lab.training.pool import FeaturePool

_EPSILON = 1e-3  # of the batch norms of EfficientNet
_VOCABULARY_VIEWS = 1500
_BATCH = 32
_PATCH_PLACES, _PATCHES_A_PLACE = 400, 50  # corresponding patches that the patches' whitening is learned from
_PATCH_REACH = 0.5  # cells between corresponding patches, at most


def imagenet_trunk(weights: Path | str, variant: int, deep: bool = False) -> TorchTrunk:
    """A trunk without neck from an EfficientNet-Lite file (.pth; the names of efficientnet-lite-pytorch), norms folded.

    Raises ModelError for a file that holds anything else.
    """
    try:
        tensors = torch.load(weights, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError) as error:
        raise ModelError(f"{weights}: not a readable tensor file ({error})") from None
    plan = lite_trunk(variant, neck=0, deep=deep)
    trunk = TorchTrunk(plan)
    try:
        state: dict[str, Tensor] = {}
        for name in (n.removesuffix(".bias") for n in plan.tensor_shapes() if n.endswith(".bias")):
            state[f"{name}.weight"], state[f"{name}.bias"] = _folded(tensors, *_published(name, len(plan.layers) - 4))
        trunk.load_state_dict(state)
    except (KeyError, TypeError, RuntimeError) as error:
        raise ModelError(f"{weights}: no EfficientNet-Lite{variant} ({error})") from None
    return trunk.eval()


def _published(name: str, block: int) -> tuple[str, str]:
    """What the published file calls a convolution of ours and the batch norm after it; `block` holds `expand`."""
    if name == "stem":
        return "_conv_stem", "_bn0"
    if name == "expand":  # of the block after our last one
        return f"_blocks.{block}._expand_conv", f"_blocks.{block}._bn0"
    if name == "head":
        return "_conv_head", "_bn1"
    _, number, part = name.split(".")
    norm = {"expand": "_bn0", "depthwise": "_bn1", "project": "_bn2"}[part]
    return f"_blocks.{number}._{part}_conv", f"_blocks.{number}.{norm}"


def _folded(tensors: dict[str, Tensor], conv: str, norm: str) -> tuple[Tensor, Tensor]:
    """Weight and bias of a convolution that does what it and its batch norm did."""
    gain = tensors[f"{norm}.weight"] / torch.sqrt(tensors[f"{norm}.running_var"] + _EPSILON)
    weight = tensors[f"{conv}.weight"] * gain[:, None, None, None]
    return weight, tensors[f"{norm}.bias"] - tensors[f"{norm}.running_mean"] * gain


@torch.no_grad()
def initial_model(
    trunk: TorchTrunk, neck: int, pool: FeaturePool, layers: int, info: ModelInfo, options: FitOptions
) -> TorchModel:
    """A model around an ImageNet trunk, fitted to a pool of the maps that its first `layers` gave for views of places.

    The neck keeps the `neck` leading principal directions of the unit local features.
    """
    wide = (trunk.wide(m[None].float(), layers)[0] for m in pool.mild_maps(_VOCABULARY_VIEWS))
    samples = local_samples(wide, options)
    weight, _ = pca(samples, neck, whiten=False)
    whole = TorchTrunk(lite_trunk(**info.trunk_options))
    whole.load_state_dict(
        trunk.state_dict() | {"neck.weight": weight[:, :, None, None], "neck.bias": torch.zeros(neck)}
    )
    netvlad = vocabulary(F.normalize(samples @ weight.T, dim=1), options)
    model = TorchModel(info, whole.eval(), netvlad, Projection(1, 1))
    return whitened(model, pool, layers, options)


@torch.no_grad()
def whitened(model: TorchModel, pool: FeaturePool, layers: int, options: FitOptions) -> TorchModel:
    """The model with its projections learned from the pool's views of the same places."""
    beside = {"pooled_projection": options.pooled_dim, "middle_projection": options.middle_dim}
    dims = {"global_projection": options.global_dim - sum(beside.values()), **{p: d for p, d in beside.items() if d}}
    rows: dict[str, list[Tensor]] = {part: [] for part in dims}
    for start in range(0, len(pool.maps), _BATCH):
        features, wide, deep = model.trunk.back(torch.from_numpy(pool.maps[start : start + _BATCH]).float(), layers)
        given = {"pooled_projection": deep, "middle_projection": wide}
        for part, found in rows.items():
            found.append(gem(given[part]) if part in given else model.netvlad(features))
    places = torch.arange(len(pool.maps)) // pool.batches.options.views
    fitted = {part: learned_whitening(torch.cat(rows[part]), places, dim) for part, dim in dims.items()}
    fitted["patch_projection"] = learned_whitening(
        *_corresponding_patches(model, pool, layers, options), options.patch_dim
    )
    projections = {part: projection_of(*found) for part, found in fitted.items()}
    return TorchModel(model.info, model.trunk, model.netvlad, **projections)


def _corresponding_patches(
    model: TorchModel, pool: FeaturePool, layers: int, options: FitOptions
) -> tuple[Tensor, Tensor]:
    """Patch VLADs (M, K * C) of what two views of a place both show, and which of them correspond (M,)."""
    rng = np.random.default_rng(options.seed)
    views, size = pool.batches.options.views, options.patch_sizes[0]
    found: list[Tensor] = []
    numbers: list[Tensor] = []
    pairs = 0
    for place in rng.permutation(len(pool.maps) // views)[:_PATCH_PLACES]:
        rows = place * views + rng.permutation(views)[:2]
        patches, where = zip(*(_patches_of(model, pool, int(row), layers, size) for row in rows), strict=True)
        distance = torch.cdist(*where)
        nearest, index = distance.min(1)
        mutual = distance.argmin(0)[index] == torch.arange(len(index))
        chosen = torch.nonzero(mutual & (nearest < _PATCH_REACH)).flatten().numpy()
        kept = torch.from_numpy(rng.permutation(chosen)[:_PATCHES_A_PLACE])
        found += [patches[0][kept], patches[1][index[kept]]]
        numbers += [torch.arange(pairs, pairs + len(kept))] * 2
        pairs += len(kept)
    return torch.cat(found), torch.cat(numbers)


def _patches_of(model: TorchModel, pool: FeaturePool, row: int, layers: int, size: int) -> tuple[Tensor, Tensor]:
    """The patch VLADs (n, K * C) of a view and where they lie in their scene (n, 3), in cells."""
    features, *_ = model.trunk.back(torch.from_numpy(pool.maps[row : row + 1]).float(), layers)
    x, weights = model.netvlad.soft_assign(features)
    shape = (features.shape[-2], features.shape[-1])
    vlads = patch_vlads(x[0], weights[0], model.netvlad.centroids, shape, size)
    cells = torch.from_numpy(pool.coordinates[row]).float().permute(2, 0, 1)[None]
    return vlads, F.avg_pool2d(cells, size, 1)[0].flatten(1).T

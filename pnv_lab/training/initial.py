"""The state a training starts from: ImageNet trunk, principal neck, fitted vocabulary and projections."""

from collections.abc import Callable, Iterable
from pathlib import Path

import torch
from torch import Tensor

from pnv_core.describe.model_files import ModelInfo
from pnv_core.describe.torch_model import TorchModel, TorchTrunk
from pnv_core.describe.trunks.compact import compact_trunk
from pnv_core.errors import ModelError
from pnv_lab.fit import FitOptions, local_samples, pca, pooled_projection_of, projections_of, vocabulary_of


def imagenet_trunk(weights: Path | str, fires: int, relu: bool) -> TorchTrunk:
    """A compact trunk without neck from a torchvision-named SqueezeNet 1.1 file (.pth).

    Raises ModelError for a file that holds anything else.
    """
    try:
        tensors = torch.load(weights, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError) as error:
        raise ModelError(f"{weights}: not a readable tensor file ({error})") from None
    trunk = TorchTrunk(compact_trunk(fires=fires, neck=0, relu=relu))
    try:
        trunk.load_state_dict({name: tensors[name] for name in trunk.state_dict()})
    except (KeyError, TypeError, RuntimeError) as error:
        raise ModelError(f"{weights}: no SqueezeNet 1.1 trunk ({error})") from None
    return trunk.to(memory_format=torch.channels_last).eval()  # type: ignore[call-overload]


@torch.no_grad()
def initial_model(
    trunk: TorchTrunk,
    neck: int,
    maps: Callable[[], Iterable[Tensor]],
    layers: int,
    info: ModelInfo,
    options: FitOptions,
) -> TorchModel:
    """An untrained model around an ImageNet trunk, fitted to what its first `layers` gave for some images.

    The neck keeps the `neck` leading principal directions of the unit local features. `maps` gives the same maps
    (C', h, w) each time it is called.
    """
    ends = [trunk.wide(m[None].float(), layers)[0] for m in maps()]
    weight, _ = pca(local_samples(ends, options), neck, whiten=False)
    whole = TorchTrunk(compact_trunk(**info.trunk_options))
    neck_state = {"neck.weight": weight[:, :, None, None], "neck.bias": torch.zeros(neck)}
    whole.load_state_dict(trunk.state_dict() | neck_state)
    necks = [whole.run(end[None], len(whole.trunk.layers)) for end in ends]
    netvlad = vocabulary_of(necks, options)
    vlads, patches = projections_of(netvlad, necks, options)
    pooled = pooled_projection_of(ends, options)
    return TorchModel(info, whole, netvlad, vlads, patches, pooled)

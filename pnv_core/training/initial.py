"""The state a training starts from: ImageNet trunk, principal neck, fitted vocabulary and projections."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
import torch.nn.functional as F

from pnv_core.compact import CompactTrunk
from pnv_core.errors import ModelError
from pnv_core.fit import FitOptions, Progress, as_batch, fit_model, pca, plain_progress, read_rgb
from pnv_core.model_files import Model, ModelInfo


def imagenet_trunk(weights: Path | str, fires: int, relu: bool) -> CompactTrunk:
    """A compact trunk without neck from a torchvision-named SqueezeNet 1.1 file (.pth).

    Raises ModelError for a file that holds anything else.
    """
    try:
        tensors = torch.load(weights, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError) as error:
        raise ModelError(f"{weights}: not a readable tensor file ({error})") from None
    trunk = CompactTrunk(fires=fires, neck=0, relu=relu)
    wanted = set(trunk.state_dict())
    try:
        trunk.load_state_dict({name: tensors[name] for name in wanted})
    except (KeyError, TypeError, RuntimeError) as error:
        raise ModelError(f"{weights}: no SqueezeNet 1.1 trunk ({error})") from None
    return trunk.eval()


@torch.inference_mode()
def with_principal_neck(trunk: CompactTrunk, neck: int, files: Sequence[Path], options: FitOptions, progress: Progress = plain_progress) -> CompactTrunk:
    """The trunk with a linear neck that keeps the `neck` leading principal directions of its unit local features."""
    generator = torch.Generator().manual_seed(options.seed)
    drawn = []
    for path in progress(files, "neck"):
        cells = trunk.backbone(as_batch([read_rgb(path, options.image_width, options.image_height)]))[0].flatten(1).T
        drawn.append(F.normalize(cells[torch.randperm(len(cells), generator=generator)[: options.cells_per_image]], dim=1))
    weight, _ = pca(torch.cat(drawn), neck, whiten=False)
    whole = CompactTrunk(fires=sum(type(m).__name__ == "Fire" for m in trunk.features), neck=neck, relu=trunk.features[-1].relu)
    whole.features.load_state_dict(trunk.features.state_dict())
    whole.neck.load_state_dict({"weight": weight[:, :, None, None], "bias": torch.zeros(neck)})
    return whole.eval()


def initial_model(
    weights: Path | str,
    fires: int,
    neck: int,
    relu: bool,
    files: Sequence[Path],
    options: FitOptions,
    progress: Progress = plain_progress,
) -> Model:
    """An untrained model: ImageNet trunk, neck, vocabulary and projections fitted to the images."""
    trunk = imagenet_trunk(weights, fires, relu)
    if neck:
        trunk = with_principal_neck(trunk, neck, files, options, progress)
    info = ModelInfo("compact", {"fires": fires, "neck": neck, "relu": relu})
    return fit_model(trunk, replace(info, provenance="ImageNet trunk, fitted vocabulary and projections"), files, options, progress)

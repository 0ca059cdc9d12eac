"""The paper's trunk from ImageNet weights."""

from pathlib import Path

import torch

from pnv_core.describe.torch_model import TorchTrunk
from pnv_core.describe.trunks.vgg16 import vgg16_trunk
from pnv_core.errors import ModelError


def imagenet_vgg16(weights: Path | str) -> TorchTrunk:
    """A VGG16 trunk from a file of torchvision's names (`features.N...`; its classifier is not used).

    Raises ModelError for a file that holds anything else.
    """
    try:
        tensors = torch.load(weights, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError) as error:
        raise ModelError(f"{weights}: not a readable tensor file ({error})") from None
    trunk = TorchTrunk(vgg16_trunk())
    try:
        trunk.load_state_dict({name: tensors[name] for name in trunk.state_dict()})
    except (KeyError, TypeError, RuntimeError) as error:
        raise ModelError(f"{weights}: no VGG16 trunk ({error})") from None
    return trunk

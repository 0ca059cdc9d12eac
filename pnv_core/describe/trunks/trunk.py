"""What every feature trunk is: an image to a dense feature map. C channels, h x w = H // stride x W // stride cells."""

import torch
from torch import Tensor, nn

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class Trunk(nn.Module):
    """(B, 3, H, W) RGB in [0, 1] -> (B, C, H // stride, W // stride). Subclasses state their `channels` and `stride`.

    Cell i is centred at pixel stride * i + stride / 2 - 1.
    """

    channels: int
    stride: int = 16  # pixels per feature cell

    def maps(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """The feature map, and the one before the trunk's neck (B, W, h, w); the same where there is no neck."""
        features = self(images)
        return features, features

    @property
    def width(self) -> int:
        """Channels W before the neck."""
        return self.channels


class ImageNetInput(nn.Module):
    """Subtracts the ImageNet mean and divides by the standard deviation, per channel."""

    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1), persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        return (images - self.mean) / self.std

"""What every feature trunk is: an image to a dense feature map. C channels, h x w = H // stride x W // stride cells."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pnv_core.networks.layers import Crop, Network, Scale, channels_after, shape_after, tensor_shapes

IMAGENET_INPUT = Scale((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))  # mean and standard deviation of ImageNet

Dense = Callable[[NDArray], NDArray[np.float32]]


@dataclass(frozen=True)
class Trunk:
    """(3, H, W) RGB in [0, 1] -> wide maps (W, h, w), and after the neck features (C, h, w), C = W without one.

    What the generalised mean is taken of are the wide maps, or what the layers `deep` make of them, (E, h', w').
    Weights have the names that the layers give them. `dense` stands for a trunk that is no network: an image
    (H, W, 3), uint8 or float in [0, 1], to its map (`dense_channels`, h, w).
    Cell i is centred at pixel stride * i + stride / 2 - 1.
    """

    layers: Network
    neck: Network = ()
    deep: Network = ()  # beside the neck
    dense: Dense | None = None
    dense_channels: int = 0
    stride: int = 16  # pixels per feature cell
    precise: int = 0  # of the first layers, those that stay in float32 where the others compute in bfloat16

    @property
    def width(self) -> int:
        """Channels W before the neck."""
        return self.dense_channels or channels_after(self.layers, 3)

    @property
    def pooled_width(self) -> int:
        """Channels E of what the generalised mean is taken of."""
        return channels_after(self.deep, self.width)

    @property
    def channels(self) -> int:
        return channels_after(self.neck, self.width)

    @property
    def input_layers(self) -> int:
        """How many of the first layers only prepare the image."""
        return next((i for i, layer in enumerate(self.layers) if not isinstance(layer, Crop | Scale)), 0)

    def tensor_shapes(self) -> dict[str, tuple[int, ...]]:
        """Its weights by name."""
        after = tensor_shapes(self.neck, self.width) | tensor_shapes(self.deep, self.width)
        return tensor_shapes(self.layers, 3) | after

    def shape(self, width: int, height: int) -> tuple[int, int, int]:
        """(C, h, w) of the features of an image."""
        if self.dense is not None:
            return self.channels, height // self.stride, width // self.stride
        return shape_after(self.neck, shape_after(self.layers, (3, height, width)))

    def pooled_shape(self, cells: tuple[int, int]) -> tuple[int, int, int]:
        """(E, h', w') of what the generalised mean is taken of, for (h, w) cells."""
        return shape_after(self.deep, (self.width, *cells))

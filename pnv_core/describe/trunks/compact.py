"""The compact trunk of the default model. C channels, h x w = H // 16 x W // 16 cells."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pnv_core.describe.trunks.trunk import ImageNetInput, Trunk

FIRES = 6  # of SqueezeNet's eight Fire modules: what the last two add is tuned to ImageNet's classes


class Fire(nn.Module):
    """Squeeze and expand (SqueezeNet 1.1, Iandola et al. 2016): 1x1, then 1x1 beside 3x3."""

    def __init__(self, inputs: int, squeeze: int, expand: int, relu: bool = True) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeeze, 1)
        self.expand1x1 = nn.Conv2d(squeeze, expand, 1)
        self.expand3x3 = nn.Conv2d(squeeze, expand, 3, padding=1)
        self.relu = relu

    def forward(self, x: Tensor) -> Tensor:
        x = F.relu(self.squeeze(x))
        x = torch.cat([self.expand1x1(x), self.expand3x3(x)], dim=1)
        return F.relu(x) if self.relu else x


class CompactTrunk(Trunk):
    """SqueezeNet 1.1 up to `fires` Fire modules and a linear 1x1 neck to `neck` channels (0 = no neck).

    Layer numbers in `features` are torchvision's, so that ImageNet weights load by name. The padding differs: it is
    chosen such that cell i is centred at pixel 16 i + 7, as in VGG16, and 640x480 gives 30 x 40 cells.
    `relu` says whether the last Fire module ends in a ReLU.
    """

    _SQUEEZE = (16, 16, 32, 32, 48, 48, 64, 64)
    _EXPAND = (64, 64, 128, 128, 192, 192, 256, 256)

    def __init__(self, fires: int = FIRES, neck: int = 128, relu: bool = True) -> None:
        super().__init__()
        self.input = ImageNetInput()
        layers: list[nn.Module] = [
            nn.Conv2d(3, 64, 3, stride=2),
            nn.ReLU(inplace=True),
            nn.MaxPool2d(3, 2, ceil_mode=True),
        ]
        width = 64
        for number in range(fires):
            if number == 2:
                layers.append(nn.MaxPool2d(3, 2, ceil_mode=True))
            if number == 4:
                layers.append(nn.MaxPool2d(3, 2, padding=1))
            last = number == fires - 1
            layers.append(Fire(width, self._SQUEEZE[number], self._EXPAND[number], relu=relu or not last))
            width = 2 * self._EXPAND[number]
        self.features = nn.Sequential(*layers)
        self.neck = nn.Conv2d(width, neck, 1) if neck else nn.Identity()
        self.channels = neck or width
        self._width = width

    @property
    def width(self) -> int:
        return self._width

    def front(self, images: Tensor, layers: int) -> Tensor:
        """(B, 3, H, W) -> what the first `layers` of `features` give."""
        height, width = (side // self.stride * self.stride for side in images.shape[2:])
        x = self.input(images[:, :, :height, :width])
        return self.features[:layers](F.pad(x, (0, 1, 0, 1)))

    def back(self, maps: Tensor, layers: int) -> tuple[Tensor, Tensor]:
        """The rest after `front` with as many layers, as `maps` gives it."""
        wide = self.features[layers:](maps)
        return self.neck(wide), wide

    def maps(self, images: Tensor) -> tuple[Tensor, Tensor]:
        return self.back(self.front(images, len(self.features)), len(self.features))

    def forward(self, images: Tensor) -> Tensor:
        return self.maps(images)[0]

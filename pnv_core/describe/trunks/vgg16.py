"""VGG16, the trunk of the paper."""

from torch import Tensor, nn

from pnv_core.describe.trunks.trunk import ImageNetInput, Trunk


class VGG16Trunk(Trunk):
    """VGG16 without batch normalisation up to conv5_3, before its ReLU (Patch-NetVLAD section 4.1).

    Layer numbers in `features` are torchvision's, so that official checkpoints load by name.
    """

    channels = 512
    _BLOCKS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))

    def __init__(self) -> None:
        super().__init__()
        self.input = ImageNetInput()
        layers: list[nn.Module] = []
        previous = 3
        for number, block in enumerate(self._BLOCKS):
            if number:
                layers.append(nn.MaxPool2d(2, 2))
            for width in block:
                layers += [nn.Conv2d(previous, width, 3, padding=1), nn.ReLU(inplace=True)]
                previous = width
        self.features = nn.Sequential(*layers[:-1])

    def forward(self, images: Tensor) -> Tensor:
        features: Tensor = self.features(self.input(images))
        return features

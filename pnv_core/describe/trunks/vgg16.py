"""VGG16, the trunk of the paper."""

from pnv_core.describe.trunks.trunk import IMAGENET_INPUT, Trunk
from pnv_core.networks.layers import Conv, Layer, MaxPool, Relu, same_pads

_BLOCKS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))


def vgg16_trunk() -> Trunk:
    """VGG16 without batch normalisation up to conv5_3, before its ReLU (Patch-NetVLAD section 4.1).

    Layer numbers are torchvision's, so that official checkpoints load by name.
    """
    layers: list[Layer] = []
    for number, block in enumerate(_BLOCKS):
        if number:
            layers.append(MaxPool(2, 2))
        for width in block:
            layers += [Conv(f"features.{len(layers)}", width, 3, pads=same_pads(3)), Relu()]
    return Trunk((IMAGENET_INPUT, *layers[:-1]))

"""The compact trunk of the default model."""

from pnv_core.describe.trunks.trunk import IMAGENET_INPUT, Trunk
from pnv_core.networks.layers import Block, Concat, Conv, Crop, Layer, MaxPool, Relu, same_pads

FIRES = 6  # of SqueezeNet's eight Fire modules: what the last two add is tuned to ImageNet's classes

_SQUEEZE = (16, 16, 32, 32, 48, 48, 64, 64)
_EXPAND = (64, 64, 128, 128, 192, 192, 256, 256)


def compact_trunk(fires: int = FIRES, neck: int = 128, relu: bool = True) -> Trunk:
    """SqueezeNet 1.1 (Iandola et al. 2016) up to `fires` Fires and a linear 1x1 neck to `neck` channels (0: none).

    Layer numbers are torchvision's, so that ImageNet weights load by name. The padding differs: it is chosen such that
    cell i is centred at pixel 16 i + 7, as in VGG16, and 640x480 gives 30 x 40 cells.
    `relu` says whether the last Fire module ends in a ReLU.
    """
    layers: list[Layer] = [Conv("features.0", 64, 3, 2, (0, 0, 1, 1)), Relu(), MaxPool(3, 2, ceil=True)]
    for number in range(fires):
        if number == 2:
            layers.append(MaxPool(3, 2, ceil=True))
        if number == 4:
            layers.append(MaxPool(3, 2, same_pads(3)))
        name = f"features.{len(layers)}"
        layers.append(_fire(name, _SQUEEZE[number], _EXPAND[number], relu or number < fires - 1))
    return Trunk((Crop(16), IMAGENET_INPUT, *layers), (Conv("neck", neck),) if neck else ())


def _fire(name: str, squeeze: int, expand: int, relu: bool) -> Block:
    """Squeeze and expand: 1x1, then 1x1 beside 3x3."""
    one = Conv(f"{name}.expand1x1", expand)
    three = Conv(f"{name}.expand3x3", expand, 3, pads=same_pads(3))
    expanded = Conv(f"{name}.squeeze", squeeze), Relu(), Concat(((one,), (three,)))
    return Block((*expanded, Relu()) if relu else expanded)

"""The trunk of the default model: EfficientNet-Lite."""

import math

from pnv_core.describe.trunks.trunk import Trunk
from pnv_core.networks.layers import Add, Block, Conv, Crop, Layer, Network, Pads, Relu, Scale

# Repeats, kernel, stride, expansion and output channels of the stages up to stride 16, and after it (EfficientNet-B0,
# Tan and Le, ICML 2019, table 1; the Lite variants have ReLU6 and no squeeze-and-excitation). Lite0 and Lite1 are
# equally wide.
_STAGES = ((1, 3, 1, 1, 16), (2, 3, 2, 6, 24), (2, 5, 2, 6, 40), (3, 3, 2, 6, 80), (3, 5, 1, 6, 112))
_DEEP_STAGES = ((4, 5, 2, 6, 192), (1, 3, 1, 6, 320))
_HEAD = 1280
_STEM = 32
_EXPANSION = 6
_DEPTH = {0: 1.0, 1: 1.1}  # factor of the repeats, by variant
_PADS_BEFORE = 3  # the stage that pads before, not after: cell i is then centred at pixel 16 i + 7
_PRECISE = 4  # crop, scale, stem and the first block, whose kernels of large weights cancel: nine tenths of the error
_INPUT = Scale((127 / 255,) * 3, (128 / 255,) * 3)  # (255 x - 127) / 128
_RELU6 = Relu(6.0)


def lite_trunk(variant: int = 1, neck: int = 128, deep: bool = False) -> Trunk:
    """EfficientNet-Lite 0 or 1 with folded batch norms, up to the expansion of its first block of stride 32 (672
    channels at stride 16), and a linear 1x1 neck to `neck` channels (0 = none).

    With `deep` what is pooled are the maps before its own pooling (1280 channels at stride 32), else the 672.
    """
    layers: list[Layer] = [Block((Conv("stem", _STEM, 3, 2, (0, 0, 1, 1)), _RELU6))]
    width = _STEM
    for stage, (repeats, kernel, stride, expansion, outputs) in enumerate(_STAGES):
        for i in range(math.ceil(repeats * _DEPTH[variant]) if stage else repeats):
            step = 1 if i else stride
            before, after = (kernel - step) // 2, (kernel - 1) // 2
            pads = (
                (after, after, before, before)
                if stage == _PADS_BEFORE and step == 2
                else (before, before, after, after)
            )
            layers.append(
                _inverted_residual(f"blocks.{len(layers) - 1}", width, outputs, kernel, step, expansion, pads)
            )
            width = outputs
    layers.append(Block((Conv("expand", _EXPANSION * width), _RELU6)))
    beside = _deep(len(layers) - 2, width, _DEPTH[variant]) if deep else ()
    narrowed = (Conv("neck", neck),) if neck else ()
    return Trunk((Crop(Trunk.stride), _INPUT, *layers), narrowed, beside, precise=_PRECISE)


def _deep(block: int, width: int, depth: float) -> Network:
    """The rest of the network after the expansion in `block`, of a map of so many channels."""
    layers: list[Layer] = []
    for number, (repeats, kernel, stride, expansion, outputs) in enumerate(_DEEP_STAGES):
        for i in range(repeats if number else math.ceil(repeats * depth)):
            step = 1 if i else stride
            before, after = (kernel - step) // 2, (kernel - 1) // 2
            whole = _inverted_residual(
                f"blocks.{block + len(layers)}", width, outputs, kernel, step, expansion, (before, before, after, after)
            )
            layers.append(whole if layers else Block(whole.layers[2:]))
            width = outputs
    return (*layers, Block((Conv("head", _HEAD), _RELU6)))


def _inverted_residual(
    name: str, inputs: int, outputs: int, kernel: int, stride: int, expansion: int, pads: Pads
) -> Block:
    """Expand, filter each channel, project (MobileNetV2, Sandler et al., CVPR 2018); added to an input of its shape."""
    width = inputs * expansion
    expand: tuple[Layer, ...] = (Conv(f"{name}.expand", width), _RELU6) if expansion > 1 else ()
    depthwise = Conv(f"{name}.depthwise", width, kernel, stride, pads, groups=width), _RELU6
    branch = (*expand, *depthwise, Conv(f"{name}.project", outputs))
    return Block((Add((branch, ())),)) if stride == 1 and inputs == outputs else Block(branch)

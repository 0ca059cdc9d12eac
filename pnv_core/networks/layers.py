"""A network is a tuple of layers: small frozen records that name their weights. The backends interpret them.

Shapes are (channels, height, width) of one image; `pads` are (top, left, bottom, right) in pixels.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeAlias

Pads: TypeAlias = tuple[int, int, int, int]
Shape: TypeAlias = tuple[int, int, int]


@dataclass(frozen=True)
class Crop:
    """Height and width cut to multiples of `cell`, at the right and at the bottom."""

    cell: int


@dataclass(frozen=True)
class Scale:
    """(x - mean) / std per channel."""

    mean: tuple[float, ...]
    std: tuple[float, ...]


@dataclass(frozen=True)
class Conv:
    """Convolution with weights `name`.weight (outputs, inputs / groups, kernel, kernel), with `bias` `name`.bias."""

    name: str
    outputs: int
    kernel: int = 1
    stride: int = 1
    pads: Pads = (0, 0, 0, 0)
    groups: int = 1
    bias: bool = True


@dataclass(frozen=True)
class Relu:
    """max(x, 0), cut at `most` where given (6: ReLU6)."""

    most: float | None = None


@dataclass(frozen=True)
class MaxPool:
    """With `ceil` the last window may reach beyond the map. Padding is never the largest."""

    kernel: int
    stride: int
    pads: Pads = (0, 0, 0, 0)
    ceil: bool = False


@dataclass(frozen=True)
class AvgPool:
    kernel: int
    stride: int


@dataclass(frozen=True)
class InstanceNorm:
    """Mean 0 and variance 1 of each channel over the image."""

    epsilon: float = 1e-5


@dataclass(frozen=True)
class Resize:
    """Bilinear, pixel centres aligned, `factor` times as large."""

    factor: int


@dataclass(frozen=True)
class SpaceToDepth:
    """Blocks of block x block pixels become channels, numbered channel by channel, row by row."""

    block: int


@dataclass(frozen=True)
class Sigmoid:
    pass


@dataclass(frozen=True)
class Block:
    """Layers that are counted as one."""

    layers: "Network"


@dataclass(frozen=True)
class Add:
    """The sum of what each branch makes of the same input; an empty branch is the input itself (a residual)."""

    branches: "tuple[Network, ...]"


@dataclass(frozen=True)
class Concat:
    """The channels of each branch, one after another."""

    branches: "tuple[Network, ...]"


Layer: TypeAlias = (
    Crop
    | Scale
    | Conv
    | Relu
    | MaxPool
    | AvgPool
    | InstanceNorm
    | Resize
    | SpaceToDepth
    | Sigmoid
    | Block
    | Add
    | Concat
)
Network: TypeAlias = tuple[Layer, ...]


def same_pads(kernel: int) -> Pads:
    """Those that keep the size at stride 1."""
    return (kernel // 2,) * 4


def shape_after(network: Network, shape: Shape) -> Shape:
    """What the network gives for an input of this shape. Raises ValueError where branches do not fit one another."""
    for layer in network:
        shape = _shape(layer, shape)
    return shape


def _shape(layer: Layer, shape: Shape) -> Shape:
    c, h, w = shape
    match layer:
        case Crop(cell=cell):
            return c, h // cell * cell, w // cell * cell
        case Conv(outputs=outputs, kernel=k, stride=s, pads=p):
            return outputs, (h + p[0] + p[2] - k) // s + 1, (w + p[1] + p[3] - k) // s + 1
        case MaxPool(kernel=k, stride=s, pads=p, ceil=ceil):
            sides = ((h, p[0], p[2]), (w, p[1], p[3]))
            rows, cols = (_pooled(side, before, after, k, s, ceil) for side, before, after in sides)
            return c, rows, cols
        case AvgPool(kernel=k, stride=s):
            return c, (h - k) // s + 1, (w - k) // s + 1
        case Resize(factor=f):
            return c, h * f, w * f
        case SpaceToDepth(block=b):
            return c * b * b, h // b, w // b
        case Block(layers=layers):
            return shape_after(layers, shape)
        case Add(branches=branches) | Concat(branches=branches):
            shapes = [shape_after(branch, shape) for branch in branches]
            summed = isinstance(layer, Add)
            if len({s if summed else s[1:] for s in shapes}) != 1:
                raise ValueError(f"branches give {shapes}; allowed: {'equal shapes' if summed else 'maps of one size'}")
            return (shapes[0][0] if summed else sum(s[0] for s in shapes)), *shapes[0][1:]
    return shape


def _pooled(side: int, before: int, after: int, kernel: int, stride: int, ceil: bool) -> int:
    reach = side + before + after - kernel
    count = (-(-reach // stride) if ceil else reach // stride) + 1
    if ceil and (count - 1) * stride >= side + before:  # the last window has to begin on the map
        count -= 1
    return count


def convolutions(network: Network, channels: int) -> Iterator[tuple[Conv, int]]:
    """Every convolution with the channels it takes, in order; `channels` of the network's input."""
    for layer in network:
        if isinstance(layer, Conv):
            yield layer, channels
        elif isinstance(layer, Block):
            yield from convolutions(layer.layers, channels)
        elif isinstance(layer, Add | Concat):
            for branch in layer.branches:
                yield from convolutions(branch, channels)
        channels = channels_after((layer,), channels)


def channels_after(network: Network, channels: int) -> int:
    """Channels the network gives for an input of so many."""
    for layer in network:
        match layer:
            case Conv(outputs=outputs):
                channels = outputs
            case SpaceToDepth(block=b):
                channels *= b * b
            case Block(layers=layers):
                channels = channels_after(layers, channels)
            case Add(branches=branches):
                channels = channels_after(branches[0], channels)
            case Concat(branches=branches):
                channels = sum(channels_after(branch, channels) for branch in branches)
    return channels


def tensor_shapes(network: Network, channels: int) -> dict[str, tuple[int, ...]]:
    """The weights a network wants, by name."""
    found: dict[str, tuple[int, ...]] = {}
    for conv, inputs in convolutions(network, channels):
        found[f"{conv.name}.weight"] = (conv.outputs, inputs // conv.groups, conv.kernel, conv.kernel)
        if conv.bias:
            found[f"{conv.name}.bias"] = (conv.outputs,)
    return found

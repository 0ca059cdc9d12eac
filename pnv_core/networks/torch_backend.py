"""Networks in torch: for training, for CUDA, and as the oracle of the other backend. B images at once."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pnv_core.networks.layers import (
    Add,
    AvgPool,
    Block,
    Concat,
    Conv,
    Crop,
    InstanceNorm,
    Layer,
    MaxPool,
    Network,
    Relu,
    Resize,
    Scale,
    Sigmoid,
    SpaceToDepth,
    convolutions,
)


class TorchNetwork(nn.Module):
    """A network whose parameters have the names its layers give them."""

    def __init__(self, network: Network, channels: int = 3) -> None:
        super().__init__()
        self.network = network
        self.add(network, channels)

    def add(self, network: Network, channels: int) -> None:
        """Parameters for a network whose input has so many channels."""
        for conv, inputs in convolutions(network, channels):
            module = nn.Conv2d(inputs, conv.outputs, conv.kernel, conv.stride, groups=conv.groups, bias=conv.bias)
            *folders, last = conv.name.split(".")
            place: nn.Module = self
            for folder in folders:
                if not hasattr(place, folder):
                    place.add_module(folder, nn.Module())
                place = getattr(place, folder)
            place.add_module(last, module)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) through every layer."""
        return self.run(x)

    def run(self, x: Tensor, first: int = 0, end: int | None = None) -> Tensor:
        """(B, C, H, W) through the layers first..end."""
        return self._run(self.network[first:end], x)

    def parameters_of(self, first: int, end: int) -> list[nn.Parameter]:
        """The parameters of the layers first..end."""
        convs = (self.get_submodule(conv.name) for conv, _ in convolutions(self.network[first:end], 0))
        return [p for conv in convs for p in conv.parameters()]

    def _run(self, network: Network, x: Tensor) -> Tensor:
        for layer in network:
            x = self._step(layer, x)
        return x

    def _step(self, layer: Layer, x: Tensor) -> Tensor:
        match layer:
            case Crop(cell=cell):
                return x[..., : x.shape[-2] // cell * cell, : x.shape[-1] // cell * cell]
            case Scale(mean=mean, std=std):
                return (x - x.new_tensor(mean).view(1, -1, 1, 1)) / x.new_tensor(std).view(1, -1, 1, 1)
            case Conv(name=name, pads=(top, left, bottom, right)):
                return self.get_submodule(name)(F.pad(x, (left, right, top, bottom)))
            case Relu(most=most):
                return F.relu(x) if most is None else x.clamp(0.0, most)
            case MaxPool(kernel=k, stride=s, pads=(top, left, bottom, right), ceil=ceil):
                padded = F.pad(x, (left, right, top, bottom), value=-torch.inf)
                return F.max_pool2d(padded, k, s, ceil_mode=ceil)
            case AvgPool(kernel=k, stride=s):
                return F.avg_pool2d(x, k, s)
            case InstanceNorm(epsilon=epsilon):
                return F.instance_norm(x, eps=epsilon)
            case Resize(factor=factor):
                return F.interpolate(x, scale_factor=factor, mode="bilinear", align_corners=False)
            case SpaceToDepth(block=block):
                return F.pixel_unshuffle(x, block)
            case Sigmoid():
                return torch.sigmoid(x)
            case Block(layers=layers):
                return self._run(layers, x)
            case Add(branches=branches):
                return torch.stack([self._run(branch, x) for branch in branches]).sum(0)
            case Concat(branches=branches):
                return torch.cat([self._run(branch, x) for branch in branches], dim=1)

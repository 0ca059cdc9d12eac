"""A Model in torch: for training, for CUDA, and as the oracle of the numbers. B images, K clusters, C channels."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from pnv_core.describe.model_files import BESIDE, OPTIONAL, Model, ModelInfo, build_model, shares_of
from pnv_core.describe.netvlad import NetVLAD, Projection, gem
from pnv_core.describe.patches import patch_descriptors
from pnv_core.describe.trunks.trunk import Trunk
from pnv_core.errors import ConfigError
from pnv_core.networks.torch_backend import TorchNetwork


class TorchTrunk(TorchNetwork):
    """A trunk; its parameters have the names of the model file. (B, 3, H, W) RGB in [0, 1] in."""

    def __init__(self, trunk: Trunk) -> None:
        super().__init__((*trunk.layers, *trunk.neck))
        self.add(trunk.deep, trunk.width)
        self.trunk = trunk
        self.channels, self.width, self.stride = trunk.channels, trunk.width, trunk.stride

    @property
    def depth(self) -> int:
        """Layers before the neck, after those that prepare the image."""
        return len(self.trunk.layers) - self.trunk.input_layers

    def maps(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The feature map (B, C, h, w), that before the neck (B, W, h, w), and the deep one (B, E, h', w')."""
        if self.trunk.dense is not None:
            features = [self.trunk.dense(image) for image in images.permute(0, 2, 3, 1).cpu().numpy()]
            found = torch.from_numpy(np.stack(features)).to(images.device)
            return found, found, found
        return self.back(self.front(images, 0), 0)

    def forward(self, images: Tensor) -> Tensor:
        return self.maps(images)[0]

    def front(self, images: Tensor, layers: int) -> Tensor:
        """(B, 3, H, W) -> what the first `layers`, after those that prepare the image, give."""
        return self.run(images, 0, self.trunk.input_layers + layers)

    def back(self, maps: Tensor, layers: int) -> tuple[Tensor, Tensor, Tensor]:
        """The rest after `front` with as many layers: what `maps` gives."""
        wide = self.wide(maps, layers)
        return self.run(wide, len(self.trunk.layers)), wide, self._run(self.trunk.deep, wide)

    def wide(self, maps: Tensor, layers: int) -> Tensor:
        """As `back`, before the neck: (B, W, h, w)."""
        return self.run(maps, self.trunk.input_layers + layers, len(self.trunk.layers))

    def front_parameters(self, layers: int) -> list[nn.Parameter]:
        """Those that `front` uses."""
        return self.parameters_of(0, self.trunk.input_layers + layers)


@dataclass(frozen=True, eq=False)
class TorchModel:
    """As Model, in modules."""

    info: ModelInfo
    trunk: TorchTrunk
    netvlad: NetVLAD
    global_projection: Projection
    patch_projection: Projection | None = None
    pooled_projection: Projection | None = None
    middle_projection: Projection | None = None

    @classmethod
    def of(cls, model: Model) -> "TorchModel":
        """The same model, for inference."""
        modules: dict[str, nn.Module] = {"trunk": TorchTrunk(model.trunk)}
        modules["netvlad"] = NetVLAD(*model.tensors["netvlad.centroids"].shape)
        for part in ("global_projection", *OPTIONAL):
            if model.has(part):
                outputs, inputs = model.tensors[f"{part}.weight"].shape
                modules[part] = Projection(inputs, outputs)
        for part, module in modules.items():
            module.load_state_dict({name: torch.from_numpy(t) for name, t in model.part(part).items()})
            module.eval().requires_grad_(False)
        return cls(model.info, **modules)  # type: ignore[arg-type]

    def tensors(self) -> dict[str, Tensor]:
        """Every learned tensor by its name in the file."""
        return {f"{part}.{k}": v.detach() for part, m in self.parts().items() for k, v in m.state_dict().items()}

    def model(self) -> Model:
        """As it is saved and described with."""
        arrays = {name: tensor.float().cpu().numpy() for name, tensor in self.tensors().items()}
        return build_model(self.info, arrays, "this model")

    def parts(self) -> dict[str, nn.Module]:
        """The modules by the names of the model file."""
        names = ("trunk", "netvlad", "global_projection", *OPTIONAL)
        return {name: module for name in names if (module := getattr(self, name)) is not None}

    @property
    def patches_projection(self) -> Projection:
        return self.patch_projection or self.global_projection

    def global_vector(self, vlad: Tensor, wide: Tensor, deep: Tensor, cells: Tensor | None = None) -> Tensor:
        """VLADs (B, K * C), maps before the neck (B, W, h, w) and deep ones (B, E, h', w') -> unit vectors (B, D).

        `cells` (B, 1, h, w) say how much each cell counts.
        """
        return self.joined({"global_projection": vlad, **self.means(wide, deep, cells)})

    def means(self, wide: Tensor, deep: Tensor, cells: Tensor | None = None) -> dict[str, Tensor]:
        """The generalised means (B, W or E) that are projected beside the VLAD, by their parts' names."""
        maps = {"pooled_projection": deep, "middle_projection": wide}
        return {part: _mean(maps[part], cells) for part in BESIDE if getattr(self, part) is not None}

    def joined(self, inputs: dict[str, Tensor]) -> Tensor:
        """VLADs (B, K * C) and generalised means, by the parts that project them -> unit global vectors (B, D)."""
        shares = shares_of(self.info, [part for part in BESIDE if part in inputs])
        return torch.cat([getattr(self, part)(inputs[part]) * math.sqrt(s) for part, s in shares.items()], dim=1)


def _mean(maps: Tensor, cells: Tensor | None) -> Tensor:
    if cells is not None:
        cells = F.avg_pool2d(cells, cells.shape[-1] // maps.shape[-1]).flatten(1)
    return gem(maps, cells)


class TorchDescribing:
    """A model at one image size, on `device`: the plain formulation. `pixels` are (H, W, 3) uint8 of that size.

    `windows` are (size, stride) per patch size; `precision` is that of the trunk.
    """

    def __init__(
        self, model: Model, windows: Sequence[tuple[int, int]], threads: int, precision: str, device: torch.device
    ) -> None:
        self._model = TorchModel.of(model)
        self._windows, self._half, self._device = windows, precision == "bfloat16", device
        for module in self._model.parts().values():
            module.to(device)
        self._model.trunk.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._threads = threads

    def maps(self, pixels: NDArray[np.uint8]) -> tuple[NDArray[np.float32], ...]:
        """The trunk's maps: features (C, h, w), before the neck (W, h, w), and deep ones (E, h', w')."""
        with torch.inference_mode(), _threads(self._threads):
            return tuple(maps[0].cpu().numpy() for maps in self._maps(pixels))

    def _maps(self, pixels: NDArray[np.uint8]) -> tuple[Tensor, Tensor, Tensor]:
        images = torch.from_numpy(pixels.copy()).to(self._device).permute(2, 0, 1)[None].float() / 255.0
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._half):
            features, wide, deep = self._model.trunk.maps(images.contiguous(memory_format=torch.channels_last))
        return features.float(), wide.float(), deep.float()

    def describe(
        self, pixels: NDArray[np.uint8], cells: NDArray[np.float32] | None = None
    ) -> tuple[NDArray[np.float32], list[NDArray[np.float32]]]:
        """The global vector (D,) and the patches [(n, D), ...]. `cells` (h, w) say how much each cell counts."""
        with torch.inference_mode(), _threads(self._threads):
            features, wide, deep = self._maps(pixels)
            x, weights = self._model.netvlad.soft_assign(features)
            counted = None
            if cells is not None:
                counted = torch.from_numpy(cells).to(weights).reshape(1, 1, *features.shape[-2:])
                weights = weights * counted.flatten(2)
            vector = self._model.global_vector(self._model.netvlad.vlad(x, weights), wide, deep, counted)[0]
            projection, centroids = self._model.patches_projection, self._model.netvlad.centroids
            patches = patch_descriptors(
                x[0], weights[0], centroids, projection.weight, projection.bias,
                (features.shape[-2], features.shape[-1]),
                [size for size, _ in self._windows], [stride for _, stride in self._windows],
            )  # fmt: skip
            return vector.cpu().numpy(), [rows.cpu().numpy() for rows in patches]


def torch_device(name: str) -> torch.device:
    """'auto' is CUDA where there is one. Raises ConfigError for CUDA where there is none."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device = 'cuda' but torch sees no CUDA device; allowed here: cpu, auto")
    return torch.device(name)


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """torch's number of threads, for as long as this describes: the program around it has its own."""
    before = torch.get_num_threads()
    if not count or count == before:
        yield
        return
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)

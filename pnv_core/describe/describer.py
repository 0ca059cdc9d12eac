"""Describer: an image to a PlaceDescriptor. D dimensions, P patch sizes."""

import copy
import hashlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from pnv_core import kernels
from pnv_core.config import Config
from pnv_core.describe.checkpoints import load_checkpoint
from pnv_core.describe.download import resolve_weights
from pnv_core.describe.model_files import Model, load_model
from pnv_core.describe.patches import PatchAggregator, patch_descriptors
from pnv_core.describe.trunks.trunk import Trunk
from pnv_core.errors import ConfigError, ImageError
from pnv_core.threads import workers
from pnv_core.types import PatchGrid, PlaceDescriptor

_TEXTURE_PX = 16  # side of the squares that count as textured or not
_FLAT_CELL_STD = 2.0  # grey levels; sensor noise of a blank wall stays below, measured on 8-bit images


def load_describer(weights: str | Path = "default", preset: str = "default", **settings: Any) -> "Describer":
    """A describer of the shipped model, a published name or a model file, under a preset and settings of Config.

    Raises ModelError for a file that is no model and ConfigError for a wrong setting.
    """
    overrides = dict(settings)
    if str(weights) != "default":
        overrides["weights"] = str(weights)
    return describer_from(Config.make(preset, **overrides))


def describer_from(config: Config) -> "Describer":
    """The describer a Config asks for."""
    return Describer(read_model(resolve_weights(config.weights)), config)


def read_model(path: Path) -> Model:
    """A model file, or an official checkpoint (.pth.tar, .pth, .pt)."""
    official = path.name.endswith((".pth.tar", ".pth", ".pt"))
    return load_checkpoint(path) if official else load_model(path)


class Describer:
    """Patch-NetVLAD descriptors of one image at a time. `config` has every size filled in from the model."""

    def __init__(self, model: Model, config: Config | None = None) -> None:
        self.config = _completed(config or Config(), model)
        self.device = _device(self.config.device)
        self.model = model
        for module in (
            model.trunk,
            model.netvlad,
            model.global_projection,
            model.patch_projection,
            model.pooled_projection,
        ):
            if module is not None:
                module.to(self.device)
        self.trunk = _running(model.trunk, self.config.trunk_precision)
        if self.config.threads:
            torch.set_num_threads(self.config.threads)
        self.aggregator = self._aggregator()
        self.fingerprint = model.fingerprint()

    def _aggregator(self) -> PatchAggregator | None:
        """None where the plain formulation on the device serves instead."""
        if self.device.type != "cpu" or not kernels.COMPILED:
            return None
        projection = self.model.patches_projection
        pool = workers(self.config.threads)
        fast = self.config.patch_mode == "fast"
        return PatchAggregator(self.model.netvlad.centroids, projection.weight, projection.bias, pool, fast)

    @property
    def cell(self) -> int:
        """Pixels per feature cell: the trunk's stride."""
        return self.model.trunk.stride

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) in pixels that every image is resized to."""
        return self.config.image_width, self.config.image_height

    @property
    def map_fingerprint(self) -> str:
        """Of everything that descriptors must share to be compared: the model, the image size and the patch grids."""
        return hashlib.sha256(f"{self.fingerprint} {self.image_size} {self.grids()}".encode()).hexdigest()

    def grids(self) -> list[tuple[int, int, int, int]]:
        """(size, stride, rows, cols) per patch size."""
        h, w = self.config.image_height // self.cell, self.config.image_width // self.cell
        pairs = zip(self.config.patch_sizes, self.config.patch_strides, strict=True)
        return [(p, s, (h - p) // s + 1, (w - p) // s + 1) for p, s in pairs]

    def describe(self, rgb: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None) -> PlaceDescriptor:
        """(H, W, 3) uint8, optionally (H, W) bool of pixels to use -> PlaceDescriptor.

        The image is resized to the configured size without keeping its aspect (as the reference does).
        Raises ImageError for any other array.
        """
        pixels = resized(checked_image(rgb), *self.image_size)
        with torch.inference_mode():
            features, wide = self.maps(pixels)
            x, weights = self.model.netvlad.soft_assign(features)
            cells = None
            if valid is not None:
                cells = torch.from_numpy(_valid_cells(valid, features.shape[-2:])).to(weights)
                weights, cells = weights * cells, cells[0]
            vector = self.model.global_vector(self.model.netvlad.vlad(x, weights), wide, cells)[0]
            arrays = self._patches(x[0], weights[0], (features.shape[-2], features.shape[-1]))
            patches = tuple(
                PatchGrid(size, rows, cols, array, stride, self.cell)
                for array, (size, stride, rows, cols) in zip(arrays, self.grids(), strict=True)
            )
            return PlaceDescriptor(vector.cpu().numpy(), patches, texture(pixels, valid))

    def _patches(self, x: torch.Tensor, weights: torch.Tensor, shape: tuple[int, int]) -> list[NDArray[np.float32]]:
        sizes, strides = self.config.patch_sizes, self.config.patch_strides
        if self.aggregator is not None:
            return self.aggregator(x, weights, shape, sizes, strides)
        projection, centroids = self.model.patches_projection, self.model.netvlad.centroids
        arrays = patch_descriptors(x, weights, centroids, projection.weight, projection.bias, shape, sizes, strides)
        return [array.cpu().numpy() for array in arrays]

    def maps(self, pixels: NDArray[np.uint8]) -> tuple[torch.Tensor, torch.Tensor]:
        """(H, W, 3) uint8 of the configured size -> the trunk's maps (1, C, h, w) and (1, W, h, w)."""
        images = torch.from_numpy(pixels).to(self.device).permute(2, 0, 1)[None].float() / 255.0
        features, wide = self.trunk.maps(images.contiguous(memory_format=torch.channels_last))
        return features.float(), wide.float()


def _running(trunk: Trunk, precision: str) -> Trunk:
    """The trunk as it runs: channels last, in the precision asked for, the normalisation of its input in float32."""
    trunk = copy.deepcopy(trunk).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    normalisation = getattr(trunk, "input", None)
    if precision == "bfloat16" and normalisation is not None:
        trunk.bfloat16()
        normalisation.float()
        normalisation.register_forward_hook(lambda module, inputs, output: output.bfloat16())
    return trunk


def checked_image(rgb: Any) -> NDArray[np.uint8]:
    """The array, if it is an image. Raises ImageError naming shape and type otherwise."""
    if not isinstance(rgb, np.ndarray) or rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3 or 0 in rgb.shape:
        given = f"{rgb.dtype} {rgb.shape}" if isinstance(rgb, np.ndarray) else type(rgb).__name__
        raise ImageError(f"image is {given}; allowed: uint8 of shape (height, width, 3)")
    return rgb


def resized(rgb: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """Bilinear with anti-aliasing and 8-bit rounding, as the reference resizes (Pillow)."""
    if rgb.shape[:2] == (height, width):
        return rgb.copy()  # callers may hand in read-only message buffers, which torch refuses
    return np.asarray(Image.fromarray(rgb).resize((width, height), Image.Resampling.BILINEAR)).copy()


def texture(pixels: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None) -> float:
    """Share of the 16 px squares whose grey values vary by more than sensor noise, in [0, 1]; of valid ones only."""
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY).astype(np.float32)
    h, w = max(grey.shape[0] // _TEXTURE_PX, 1), max(grey.shape[1] // _TEXTURE_PX, 1)
    mean = cv2.resize(grey, (w, h), interpolation=cv2.INTER_AREA)
    square = cv2.resize(grey * grey, (w, h), interpolation=cv2.INTER_AREA)
    textured = square - mean * mean > _FLAT_CELL_STD**2
    if valid is None:
        return float(textured.mean())
    seen = _valid_cells(valid, (h, w)).reshape(h, w) > 0.0
    return float(textured[seen].mean()) if seen.any() else 0.0


def _valid_cells(valid: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """(H, W) bool -> (1, 1, h * w) share of valid pixels, cells less than half valid cut to 0."""
    share = cv2.resize(valid.astype(np.float32), (shape[1], shape[0]), interpolation=cv2.INTER_AREA)
    return np.where(share < 0.5, 0.0, share).astype(np.float32).reshape(1, 1, -1)


def _completed(config: Config, model: Model) -> Config:
    """Config with the model's own sizes where it leaves them open."""
    info = model.info
    width, height = config.image_width or info.image_width, config.image_height or info.image_height
    sizes = config.patch_sizes or info.patch_sizes
    weights = config.patch_weights
    if not weights:
        weights = info.patch_weights if sizes == info.patch_sizes else (1.0 / len(sizes),) * len(sizes)
    done = config.replace(
        image_width=width,
        image_height=height,
        patch_sizes=sizes,
        patch_strides=config.patch_strides or (1,) * len(sizes),
        patch_weights=weights,
    )
    cell = model.trunk.stride
    cells = min(width, height) // cell
    if max(sizes) > cells:
        raise ConfigError(
            f"patch_sizes = {sizes} exceed the {width}x{height} image of {width // cell}x{height // cell} cells; "
            f"allowed: 1 to {cells}"
        )
    return done


def _device(name: str) -> torch.device:
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device = 'cuda' but torch sees no CUDA device; allowed here: cpu, auto")
    return torch.device(name)

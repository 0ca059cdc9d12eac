"""Describer: an image to a PlaceDescriptor. D dimensions, P patch sizes."""

import hashlib
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pnv_core.config import Config
from pnv_core.describe.checkpoints import load_checkpoint
from pnv_core.describe.download import cache_folder, resolve_weights
from pnv_core.describe.model_files import Model, load_model, save_model
from pnv_core.errors import ConfigError, ImageError, ModelError
from pnv_core.threads import shared
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
    """A model file, or an official checkpoint (.pth.tar, .pth, .pt).

    A checkpoint is kept as a model file in the cache folder; the next start then needs no torch.
    """
    if not path.name.endswith((".pth.tar", ".pth", ".pt")):
        return load_model(path)
    try:
        state = path.stat()
    except OSError:
        return load_checkpoint(path)  # which says what is wrong
    key = hashlib.sha256(f"{path.resolve()} {state.st_size} {state.st_mtime_ns}".encode()).hexdigest()[:16]
    converted = cache_folder() / "converted" / f"{key}.safetensors"
    if converted.exists():
        try:
            return load_model(converted)
        except ModelError:
            pass  # damaged: it is made again
    model = load_checkpoint(path)
    try:
        converted.parent.mkdir(parents=True, exist_ok=True)
        save_model(model, converted)
    except OSError:
        pass  # a home that cannot be written to costs time, nothing else
    return model


class Describing(Protocol):
    """What computes descriptors: a model at one image size, in one library."""

    def maps(self, pixels: NDArray[np.uint8]) -> tuple[NDArray[np.float32], ...]: ...

    def describe(
        self, pixels: NDArray[np.uint8], cells: NDArray[np.float32] | None = None
    ) -> tuple[NDArray[np.float32], list[NDArray[np.float32]]]: ...


def backend_of(config: Config) -> str:
    """'openvino' or 'torch', as the Config asks for. Raises ConfigError where device and backend exclude each other."""
    if config.backend == "auto":
        if config.device == "cpu":
            return "openvino"
        from pnv_core.describe.torch_model import torch_device

        return "torch" if torch_device(config.device).type == "cuda" else "openvino"
    if config.backend == "openvino" and config.device == "cuda":
        raise ConfigError("backend = 'openvino' runs on the processor; allowed with device = 'cuda': torch, auto")
    return config.backend


def precision_of(config: Config, model: Model) -> str:
    """'float32' or 'bfloat16', as the Config asks for."""
    if config.trunk_precision != "auto":
        return config.trunk_precision
    if not model.trunk.precise or backend_of(config) != "openvino":
        return "float32"
    from pnv_core.networks.openvino_backend import native_precision

    return native_precision()


def _describing(model: Model, config: Config) -> Describing:
    windows = list(zip(config.patch_sizes, config.patch_strides, strict=True))
    threads, _ = shared(config.threads, bool(config.verify))
    if backend_of(config) == "torch":
        from pnv_core.describe.torch_model import TorchDescribing, torch_device  # seconds to import

        return TorchDescribing(model, windows, threads, config.trunk_precision, torch_device(config.device))
    from pnv_core.describe.openvino_describing import OpenVinoDescribing

    size, cache = (config.image_width, config.image_height), cache_folder() / "openvino"
    return OpenVinoDescribing(model, size, windows, threads, config.trunk_precision, cache)


class Describer:
    """Patch-NetVLAD descriptors of one image at a time. `config` has the sizes and the precision filled in."""

    def __init__(self, model: Model, config: Config | None = None) -> None:
        self.config = _completed(config or Config(), model)
        self.model = model
        self.backend = backend_of(self.config)
        self.fingerprint = model.fingerprint()
        self._describing = _describing(model, self.config)
        model.release()

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

    @property
    def cells(self) -> tuple[int, int]:
        """(rows, columns) of the feature map."""
        return self.config.image_height // self.cell, self.config.image_width // self.cell

    def grids(self) -> list[tuple[int, int, int, int]]:
        """(size, stride, rows, cols) per patch size."""
        h, w = self.cells
        pairs = zip(self.config.patch_sizes, self.config.patch_strides, strict=True)
        return [(p, s, (h - p) // s + 1, (w - p) // s + 1) for p, s in pairs]

    def describe(self, rgb: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None) -> PlaceDescriptor:
        """(H, W, 3) uint8, optionally (H, W) bool of pixels to use -> PlaceDescriptor.

        The image is resized to the configured size without keeping its aspect (as the reference does).
        Raises ImageError for any other array.
        """
        pixels = resized(checked_image(rgb), *self.image_size)
        cells = None if valid is None else _valid_cells(valid, self.cells)
        vector, arrays = self._describing.describe(pixels, cells)
        patches = tuple(
            PatchGrid(size, rows, cols, array, stride, self.cell)
            for array, (size, stride, rows, cols) in zip(arrays, self.grids(), strict=True)
        )
        return PlaceDescriptor(vector, patches, texture(pixels, valid))

    def maps(self, pixels: NDArray[np.uint8]) -> tuple[NDArray[np.float32], ...]:
        """(H, W, 3) uint8 of the configured size -> the trunk's maps (C, h, w), before its neck (W, h, w), deep."""
        return self._describing.maps(pixels)


def checked_image(rgb: Any) -> NDArray[np.uint8]:
    """The array, if it is an image. Raises ImageError naming shape and type otherwise."""
    if not isinstance(rgb, np.ndarray) or rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3 or 0 in rgb.shape:
        given = f"{rgb.dtype} {rgb.shape}" if isinstance(rgb, np.ndarray) else type(rgb).__name__
        raise ImageError(f"image is {given}; allowed: uint8 of shape (height, width, 3)")
    return rgb


def resized(rgb: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """Bilinear with anti-aliasing and 8-bit rounding, as the reference resizes (Pillow)."""
    if rgb.shape[:2] == (height, width):
        return rgb
    return np.asarray(Image.fromarray(rgb).resize((width, height), Image.Resampling.BILINEAR))


def texture(pixels: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None) -> float:
    """Share of the 16 px squares whose grey values vary by more than sensor noise, in [0, 1]; of valid ones only."""
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY).astype(np.float32)
    h, w = max(grey.shape[0] // _TEXTURE_PX, 1), max(grey.shape[1] // _TEXTURE_PX, 1)
    mean = cv2.resize(grey, (w, h), interpolation=cv2.INTER_AREA)
    square = cv2.resize(grey * grey, (w, h), interpolation=cv2.INTER_AREA)
    textured = square - mean * mean > _FLAT_CELL_STD**2
    if valid is None:
        return float(textured.mean())
    seen = _valid_cells(valid, (h, w)) > 0.0
    return float(textured[seen].mean()) if seen.any() else 0.0


def _valid_cells(valid: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.float32]:
    """(H, W) bool -> (h, w) share of valid pixels, cells less than half valid cut to 0."""
    share = cv2.resize(valid.astype(np.float32), (shape[1], shape[0]), interpolation=cv2.INTER_AREA)
    return np.where(share < 0.5, 0.0, share).astype(np.float32)


def _completed(config: Config, model: Model) -> Config:
    """Config with the model's own sizes and this processor's precision where it leaves them open."""
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
        trunk_precision=precision_of(config, model),
    )
    cell = model.trunk.stride
    cells = min(width, height) // cell
    if max(sizes) > cells:
        raise ConfigError(
            f"patch_sizes = {sizes} exceed the {width}x{height} image of {width // cell}x{height // cell} cells; "
            f"allowed: 1 to {cells}"
        )
    return done

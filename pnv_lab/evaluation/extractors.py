"""The kinds of features an evaluation can extract. C channels, h x w feature map, K clusters, D dimensions."""

import dataclasses
import hashlib
import json
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from pnv_core.config import Config
from pnv_core.describe.describer import Describer, checked_image, describer_from, resized, texture
from pnv_core.describe.netvlad import gem
from pnv_core.describe.torch_model import TorchModel
from pnv_core.errors import ConfigError
from pnv_core.types import PatchGrid, PlaceDescriptor
from pnv_lab.evaluation.extraction import Extractor, Record, descriptor_record
from pnv_lab.evaluation.local_features import LIGHTGLUE_KINDS, lightglue_extractor, sift_record

SIFT_BINS_PX = (4, 6, 8, 10)  # the four scales of DenseVLAD (Torii et al., CVPR 2015)
_TRUNK_BIN_PX = 8  # of the RootSIFT trunk


def fingerprint(describer: Describer) -> str:
    """A hash of the model and of every setting; a number of threads and a file's name change no record."""
    settings = dataclasses.asdict(describer.config.replace(threads=0, weights=""))
    return hashlib.sha256(json.dumps([describer.fingerprint, settings], sort_keys=True).encode()).hexdigest()


class _Describing:
    """What the extractors around a Describer share."""

    def __init__(self, config: Config) -> None:
        self.describer = describer_from(config)
        self.config = self.describer.config
        self.precision = "float32" if self.config.patch_precision == "float32" else "float16"
        self.fingerprint = fingerprint(self.describer)

    def pixels(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return resized(checked_image(rgb), *self.describer.image_size)


class PatchNetVLAD(_Describing):
    """Global NetVLAD vector and VLAD patches of every size, as the describer gives them."""

    def record(self, rgb: NDArray[np.uint8]) -> Record:
        return descriptor_record(self.describer.describe(rgb), self.precision)


class PooledPatches(_Describing):
    """The paper's ablation: NetVLAD retrieves, but patches are average- or max-pooled features, without VLAD."""

    def __init__(self, kind: str, config: Config) -> None:
        super().__init__(config)
        self.model = TorchModel.of(self.describer.model)
        self.pool: Callable[..., Tensor] = F.avg_pool2d if kind == "average" else F.max_pool2d

    def record(self, rgb: NDArray[np.uint8]) -> Record:
        pixels = self.pixels(rgb)
        with torch.inference_mode():
            features, wide, deep = (torch.from_numpy(maps)[None] for maps in self.describer.maps(pixels))
            vector = self.model.global_vector(self.model.netvlad(features), wide, deep)[0]
            patches = []
            for size, stride, rows, cols in self.describer.grids():
                pooled = self.pool(features, size, stride)[0].flatten(1).T  # (rows * cols, C)
                patches.append(
                    PatchGrid(size, rows, cols, F.normalize(pooled, dim=1).numpy(), stride, self.describer.cell)
                )
        descriptor = PlaceDescriptor(vector.numpy(), tuple(patches), texture(pixels))
        return descriptor_record(descriptor, self.precision)


class GeM(_Describing):
    """Generalised-mean pooling of the trunk's features (before its neck, if it has one): (C,) unit vector."""

    def record(self, rgb: NDArray[np.uint8]) -> Record:
        with torch.inference_mode():
            deep = torch.from_numpy(self.describer.maps(self.pixels(rgb))[-1])
            return {"global": gem(deep[None])[0].numpy()}


def multiscale_vlad(model: TorchModel, rgb: NDArray[np.uint8], size: tuple[int, int]) -> Tensor:
    """(K * C,) VLAD of dense RootSIFT at DenseVLAD's four scales; `size` is the (width, height) of scale one."""
    total = None
    for bin_px in SIFT_BINS_PX:
        width, height = (max(16, round(side * _TRUNK_BIN_PX / bin_px)) for side in size)
        batch = torch.from_numpy(resized(rgb, width, height)).permute(2, 0, 1)[None].float() / 255.0
        x, weights = model.netvlad.soft_assign(model.trunk(batch))
        weights = weights * x.any(1, keepdim=True)  # cells without gradient have no descriptor
        sums = weights @ x.transpose(1, 2) - weights.sum(2, keepdim=True) * model.netvlad.centroids  # (1, K, C)
        total = sums if total is None else total + sums
    assert total is not None
    return F.normalize(F.normalize(total, dim=2).flatten(1), dim=1)[0]


class DenseVLAD:
    """Dense RootSIFT at four scales, VLAD with intra-normalisation, PCA: a model file of the trunk rootsift."""

    def __init__(self, config: Config) -> None:
        self.describer: Describer = describer_from(config)
        trunk = self.describer.model.info.trunk
        if trunk != "rootsift":
            raise ConfigError(f"densevlad needs a model of trunk rootsift; {config.weights} has {trunk}")
        self.model = TorchModel.of(self.describer.model)
        self.fingerprint = fingerprint(self.describer)

    def record(self, rgb: NDArray[np.uint8]) -> Record:
        with torch.inference_mode():
            vlad = multiscale_vlad(self.model, checked_image(rgb), self.describer.image_size)
            return {"global": self.model.global_projection(vlad).numpy()}


class LocalFeatureExtractor:
    """SIFT or LightGlue's features of the image at the size the other methods see."""

    def __init__(self, kind: str, config: Config) -> None:
        describer = describer_from(config)
        self.fingerprint, size = fingerprint(describer), describer.image_size
        if kind == "sift":
            self.features: Callable[..., dict[str, NDArray]] = partial(sift_record, size=size)
        else:
            extract = lightglue_extractor(kind, config.device)
            self.features = lambda rgb: extract(resized(checked_image(rgb), *size))

    def record(self, rgb: NDArray[np.uint8]) -> Record:
        return self.features(rgb)


KINDS: dict[str, Callable[[Config], Extractor]] = {
    "patchnetvlad": PatchNetVLAD,
    "average": partial(PooledPatches, "average"),
    "maximum": partial(PooledPatches, "maximum"),
    "gem": GeM,
    "densevlad": DenseVLAD,
    "sift": partial(LocalFeatureExtractor, "sift"),
    **{kind: partial(LocalFeatureExtractor, kind) for kind in LIGHTGLUE_KINDS},
}


def make_extractor(kind: str, config: Config) -> Extractor:
    """An extractor by its kind. Raises ConfigError for an unknown one."""
    if kind not in KINDS:
        raise ConfigError(f"features {kind!r} are not one of {', '.join(KINDS)}")
    return KINDS[kind](config)

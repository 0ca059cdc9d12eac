"""A small random model, so that tests need no trained weights: RootSIFT trunk, K = 4 clusters, D = 32 dimensions."""

import numpy as np
import torch

from pnv_core.config import Config
from pnv_core.describe.describer import Describer
from pnv_core.describe.model_files import Model, ModelInfo, build_model
from pnv_core.describe.trunks.rootsift import rootsift_trunk

WIDTH, HEIGHT = 192, 160


def small_model(seed: int = 0, clusters: int = 4, dim: int = 32) -> Model:
    generator = torch.Generator().manual_seed(seed)
    channels = rootsift_trunk().channels
    tensors = {
        "netvlad.centroids": torch.rand(clusters, channels, generator=generator) * 0.1,
        "netvlad.assignment": torch.randn(clusters, channels, generator=generator) * 5,
        "global_projection.weight": torch.randn(dim, clusters * channels, generator=generator) * 0.05,
        "global_projection.bias": torch.zeros(dim),
    }
    info = ModelInfo(
        trunk="rootsift", image_width=WIDTH, image_height=HEIGHT, patch_sizes=(2, 5), patch_weights=(0.5, 0.5)
    )
    return build_model(info, {name: tensor.numpy() for name, tensor in tensors.items()}, "small model")


def small_describer(**settings: object) -> Describer:
    return Describer(small_model(), Config.make(**settings))


def noise_image(seed: int, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (height // 8, width // 8, 3), dtype=np.uint8)
    return np.repeat(np.repeat(coarse, 8, 0), 8, 1)

"""A small random model, so that tests need no trained weights: RootSIFT trunk, K = 4 clusters, D = 32 dimensions."""

import numpy as np
import torch

from pnv_core.config import Config
from pnv_core.describe.describer import Describer
from pnv_core.describe.model_files import Model, ModelInfo
from pnv_core.describe.netvlad import NetVLAD, Projection
from pnv_core.describe.trunks import TRUNKS

WIDTH, HEIGHT = 192, 160


def small_model(seed: int = 0, clusters: int = 4, dim: int = 32) -> Model:
    generator = torch.Generator().manual_seed(seed)
    trunk = TRUNKS.make("rootsift")
    netvlad = NetVLAD(clusters, trunk.channels)
    netvlad.centroids.data = torch.rand(clusters, trunk.channels, generator=generator) * 0.1
    netvlad.assignment.data = torch.randn(clusters, trunk.channels, generator=generator) * 5
    projection = Projection(clusters * trunk.channels, dim)
    projection.weight.data = torch.randn(dim, clusters * trunk.channels, generator=generator) * 0.05
    info = ModelInfo(
        trunk="rootsift", image_width=WIDTH, image_height=HEIGHT, patch_sizes=(2, 5), patch_weights=(0.5, 0.5)
    )
    for module in (trunk, netvlad, projection):
        module.eval().requires_grad_(False)
    return Model(info, trunk, netvlad, projection)


def small_describer(**settings: object) -> Describer:
    return Describer(small_model(), Config.make(**settings))


def noise_image(seed: int, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (height // 8, width // 8, 3), dtype=np.uint8)
    return np.repeat(np.repeat(coarse, 8, 0), 8, 1)

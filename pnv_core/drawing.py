"""Pictures of a match: both images side by side, patch correspondences coloured by patch size."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from pnv_core.types import PatchMatches

Image = NDArray[np.uint8]

# Okabe and Ito's colours, told apart with any kind of colour vision; small patches first
_COLOURS = ((230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (204, 121, 167), (213, 94, 0))
_GAP = 8
_BAR = 44  # of pixels; with the size of its letters readable where the picture is 330 pixels wide
_LINES_PER_SIZE = 60  # more hide the images


def draw_match(
    query: Image, reference: Image, matches: Sequence[PatchMatches], size: tuple[int, int], caption: str
) -> Image:
    """(H, W, 3) RGB query and reference of any size -> one picture, both resized to `size` = (width, height).

    Inliers are lines coloured by patch size (all matches where none was tested); the caption and the
    legend stand below. At most 60 lines a size are drawn, spread evenly over the matches.
    """
    width, height = size
    canvas = np.full((height + _BAR, 2 * width + _GAP, 3), 24, np.uint8)
    canvas[:height, :width] = cv2.resize(query, size, interpolation=cv2.INTER_AREA)
    canvas[:height, width + _GAP :] = cv2.resize(reference, size, interpolation=cv2.INTER_AREA)
    tested = any(m.inlier.any() for m in matches)
    legend = []
    for colour, m in zip(_COLOURS, sorted(matches, key=lambda m: m.size), strict=False):
        shown = np.flatnonzero(m.inlier) if tested else np.arange(len(m.query))
        legend.append((f"size {m.size}: {len(shown)} of {len(m.query)}", colour))
        for i in (
            shown[np.linspace(0, len(shown) - 1, min(len(shown), _LINES_PER_SIZE)).astype(int)] if len(shown) else ()
        ):
            start = tuple(int(v) for v in m.query_xy[i])
            end = (int(m.reference_xy[i][0]) + width + _GAP, int(m.reference_xy[i][1]))
            cv2.line(canvas, start, end, colour, 1, cv2.LINE_AA)
            for point in (start, end):
                cv2.circle(canvas, point, 2 + m.size // 3, colour, 1, cv2.LINE_AA)
    _write_bar(canvas, height, caption, legend)
    return canvas


def _write_bar(canvas: Image, top: int, caption: str, legend: Sequence[tuple[str, tuple[int, int, int]]]) -> None:
    style = (cv2.FONT_HERSHEY_SIMPLEX, 0.9)
    x, y = 6, top + _BAR - 13
    for text, colour in [(caption, (235, 235, 235)), *legend]:
        cv2.putText(canvas, text, (x, y), *style, colour, 1, cv2.LINE_AA)
        x += cv2.getTextSize(text, *style, 1)[0][0] + 18

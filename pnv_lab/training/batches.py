"""Batches of places and views. Batch n of a seed is always the same: a resumed training goes on as it would have.

P places, V views of each, B = P * V images of H x W; h x w cells.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np
import torch
from torch import Tensor

from pnv_core.describe.trunks.trunk import Trunk
from pnv_lab.training.augment import SampledCamera, View, flat_view, panorama_view, relight, small_picture
from pnv_lab.training.sources import DEFAULT_RULE, RULES, PlaceImage, relation

PANORAMA_WEIGHT = 36.0  # a panorama holds this many times more views than a photograph
_SAME_YAW, _OTHER_YAW = np.deg2rad(20), np.deg2rad(75)
_FORWARD = 1.6  # magnification that makes a place another one: a revisit closes a loop where the robot stood
_SAME_ADVANCE, _OTHER_ADVANCE = 1.2, 1.5
_SMALL_WIDTH = (72, 140)  # pixels
_ASPECT = (-0.6, 0.2)  # log of the width over the height of a squeezed view, as a multiple of its batch's


@dataclass(frozen=True)
class BatchOptions:
    """Shape of a batch. `neighbours` places of a sequence are drawn together, as hard negatives of one another."""

    places: int = 20
    views: int = 3
    neighbours: int = 4
    sizes: tuple[tuple[int, int], ...] = ((320, 240),)  # (width, height), one drawn per batch
    strength: float = 1.0
    forward: float = 0.5  # share of the groups of neighbours in which places lie in front of one another
    thumbnails: float = 0.2  # share of the batches whose views all were stored small
    zoom: float = 0.0  # most |log| of how much nearer or farther the views of a place look
    squeezed: float = 0.0  # share of the views of another aspect, squeezed into the size as describing does
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Batch:
    """inputs (B, 3, H, W) uint8 images, or float maps of the trunk's frozen layers; positive, negative (B, B) bool.

    coordinates (B, h, w, 3) say where each cell lies in its scene; views of one `scene` number (B,) share them.
    """

    inputs: Tensor
    positive: Tensor
    negative: Tensor
    coordinates: Tensor
    scene: Tensor


class Batches(Protocol):
    """An endless series of batches; equal numbers give equal batches."""

    def __getitem__(self, number: int) -> Batch: ...


@dataclass(frozen=True, eq=False)
class Origin:
    """Where a view comes from: the image, the yaw in a panorama, whether the world is mirrored, how magnified."""

    image: PlaceImage
    yaw: float
    mirror: bool
    advance: float = 1.0


class PlaceBatches:
    """Batch n of an endless series, rendered from `images`."""

    def __init__(self, images: Sequence[PlaceImage], options: BatchOptions) -> None:
        self.images = list(images)
        self.options = options
        weights = [
            RULES.get(i.set_name, DEFAULT_RULE).weight * (PANORAMA_WEIGHT if i.panorama else 1.0) for i in self.images
        ]
        self.odds = np.array(weights) / np.sum(weights)
        self.sequences: dict[str, list[int]] = {}
        for number, image in enumerate(self.images):
            self.sequences.setdefault(image.sequence, []).append(number)

    def __getitem__(self, number: int) -> Batch:
        origins, views = self.render(number)
        return assembled(
            origins,
            torch.from_numpy(np.stack([v.pixels for v in views])).permute(0, 3, 1, 2),
            [v.coordinates for v in views],
        )

    def origins(self, number: int) -> list[Origin]:
        """Where the views of batch `number` come from: V of each place in turn."""
        rng = np.random.default_rng([self.options.seed, number, 0])
        return [
            self._near(anchor, rng) if v else anchor for anchor in self._places(rng) for v in range(self.options.views)
        ]

    def render(self, number: int) -> tuple[list[Origin], list[View]]:
        """Batch `number` before it is assembled; the first view of each place is the mildest."""
        rng = np.random.default_rng([self.options.seed, number, 1])
        size = self.options.sizes[int(rng.integers(len(self.options.sizes)))]
        small = rng.random() < self.options.thumbnails
        origins = self.origins(number)
        strengths = [self.options.strength * (1.0 if v % self.options.views else 0.5) for v in range(len(origins))]
        views = [self._view(o, size, s, rng) for o, s in zip(origins, strengths, strict=True)]
        if small:
            views = [replace(v, pixels=small_picture(v.pixels, int(rng.integers(*_SMALL_WIDTH)))) for v in views]
        return origins, views

    def _places(self, rng: np.random.Generator) -> list[Origin]:
        """The anchors of a batch: groups of neighbours from one sequence or panorama."""
        anchors: list[Origin] = []
        while len(anchors) < self.options.places:
            first = int(rng.choice(len(self.images), p=self.odds))
            mirror = bool(rng.random() < 0.5)
            count = min(self.options.neighbours, self.options.places - len(anchors))
            advances = (1.0, _FORWARD) if count > 1 and rng.random() < self.options.forward else (1.0,)
            spots = -(-count // len(advances))
            if self.images[first].panorama:
                start = rng.uniform(0, 2 * np.pi)
                group = [Origin(self.images[first], start + i * 2 * np.pi / spots, mirror) for i in range(spots)]
            else:
                members = [m for m in self.sequences[self.images[first].sequence] if not self.images[m].panorama]
                chosen = {first, *(int(m) for m in rng.choice(members, min(spots, len(members)), replace=False))}
                group = [Origin(self.images[m], 0.0, mirror) for m in sorted(chosen)[:spots]]
            anchors += [replace(origin, advance=a) for origin in group for a in advances][:count]
        return anchors

    def _near(self, anchor: Origin, rng: np.random.Generator) -> Origin:
        """Another view's origin at the anchor's place: the same image or a positive of it."""
        if anchor.image.panorama:
            return replace(anchor, yaw=anchor.yaw + rng.uniform(-_SAME_YAW, _SAME_YAW))
        members = self.sequences[anchor.image.sequence]
        others = [m for m in members if relation(anchor.image, self.images[m]) > 0] if rng.random() < 0.6 else []
        return replace(anchor, image=self.images[int(rng.choice(others))]) if others else anchor

    def _view(self, origin: Origin, size: tuple[int, int], strength: float, rng: np.random.Generator) -> View:
        view = self._rendered(origin, self._shape(size, rng), strength, rng)
        if view.pixels.shape[:2] != (size[1], size[0]):
            view = _squeezed(view, size)
        occluder = self.images[int(rng.integers(len(self.images)))].rgb
        return View(relight(view.pixels, strength, rng, occluder), view.coordinates)

    def _shape(self, size: tuple[int, int], rng: np.random.Generator) -> tuple[int, int]:
        """(width, height) that a view is taken with: its own aspect, from portrait to wide, where it is squeezed."""
        if not rng.random() < self.options.squeezed:
            return size
        aspect = np.exp(rng.uniform(*_ASPECT))
        width, height = size[0] * max(aspect, 1.0), size[1] / min(aspect, 1.0)
        return 16 * round(width / 16), 16 * round(height / 16)

    def _rendered(self, origin: Origin, size: tuple[int, int], strength: float, rng: np.random.Generator) -> View:
        advance = origin.advance * np.exp(rng.uniform(-1, 1) * self.options.zoom)
        if origin.image.panorama:
            reach = np.tan(np.deg2rad(rng.uniform(75, 92)) / 2) / advance
            field_of_view = 2 * float(np.arctan(reach))
            pitch, roll = rng.normal(0, 0.12) * strength, rng.normal(0, 0.06) * strength
            camera = SampledCamera(origin.yaw, pitch, roll, field_of_view)
            return panorama_view(origin.image.rgb, size, camera, strength, origin.mirror, rng)
        return flat_view(origin.image.rgb, size, strength, origin.mirror, rng, max(advance, 1.0))


def _squeezed(view: View, size: tuple[int, int]) -> View:
    cells = size[0] // Trunk.stride, size[1] // Trunk.stride
    return View(
        np.asarray(cv2.resize(view.pixels, size, interpolation=cv2.INTER_AREA), np.uint8),
        np.asarray(cv2.resize(view.coordinates, cells, interpolation=cv2.INTER_NEAREST), np.float32),
    )


def assembled(origins: Sequence[Origin], inputs: Tensor, coordinates: Sequence[np.ndarray]) -> Batch:
    """A Batch of views: which pairs are one place, which are two, which share a scene."""
    pairs = np.array([[_relation(a, b) for b in origins] for a in origins])
    np.fill_diagonal(pairs, 0)
    scenes: dict[tuple[int, bool], int] = {}
    scene = [scenes.setdefault((id(o.image), o.mirror), len(scenes)) for o in origins]
    return Batch(
        inputs,
        torch.from_numpy(pairs > 0),
        torch.from_numpy(pairs < 0),
        torch.from_numpy(np.stack(coordinates)).float(),
        torch.tensor(scene),
    )


def _relation(a: Origin, b: Origin) -> int:
    """1 = one place, -1 = two, 0 = not known. A mirrored world is too like its twin to be told apart."""
    known = relation(a.image, b.image)
    if a.image is b.image and a.image.panorama:
        gap = abs(np.angle(np.exp(1j * (a.yaw - b.yaw))))
        known = 1 if gap <= 2 * _SAME_YAW else -1 if gap >= _OTHER_YAW else 0
    if known >= 0 and a.mirror != b.mirror:
        return 0
    ratio = max(a.advance, b.advance) / min(a.advance, b.advance)
    if known > 0 and ratio > _SAME_ADVANCE:
        return -1 if ratio >= _OTHER_ADVANCE else 0
    return known

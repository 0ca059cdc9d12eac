"""A pool of views, rendered once and kept as the maps of the trunk's frozen layers: training without a GPU.

The frozen layers and the rendering are most of a step's work and give the same for a view every time.
N views, C' channels after the frozen layers, h x w cells.
"""

import hashlib
import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import openvino as ov
import torch
from numpy.typing import NDArray
from torch import Tensor

from pnv_core.describe.torch_model import TorchTrunk
from pnv_core.files import atomic_write
from pnv_core.networks.layers import convolutions
from pnv_core.networks.openvino_backend import Compiled, build, image_input
from pnv_lab.training.batches import Batch, Origin, PlaceBatches, assembled


class FeaturePool:
    """`groups` renderings of `batches`, on disk under `folder` (float16); building goes on where it was broken off.

    What lies there is found again by everything that shapes it: images, options, frozen layers and number of groups.
    Training batch n draws `places` places from it, neighbours together, and `views` of their views.
    """

    def __init__(self, folder: Path, batches: PlaceBatches, groups: int, places: int, views: int) -> None:
        self.folder, self.batches, self.groups = folder, batches, groups
        self.places, self.views = places, views
        self.origins: list[list[Origin]] = []

    def build(self, trunk: TorchTrunk, layers: int, progress: Iterable[int] | None = None) -> None:
        """Render what is missing and pass it through the first `layers` of the trunk."""
        place = self.folder / self._key(trunk, layers)
        place.mkdir(parents=True, exist_ok=True)
        done = place / "done.json"
        ready = int(json.loads(done.read_text())) if done.exists() else 0
        count = self.groups * self.batches.options.places * self.batches.options.views
        front: _Front | None = None
        for number in progress or range(self.groups):
            if number < ready:
                self.origins.append(self.batches.origins(number))
                continue
            origins, views = self.batches.render(number)
            if front is None or front.size != views[0].pixels.shape[:2]:
                front = _Front(trunk, layers, views[0].pixels.shape[:2])
            maps = np.stack([front(v.pixels) for v in views])
            coordinates = np.stack([v.coordinates for v in views])
            if not number:
                _create(place / "maps.npy", (count, *maps.shape[1:]))
                _create(place / "coordinates.npy", (count, *coordinates.shape[1:]))
            if number == ready:
                self._open(place)
            rows = slice(number * len(views), (number + 1) * len(views))
            self.maps[rows] = maps
            self.coordinates[rows] = coordinates
            self.origins.append(origins)
            with atomic_write(done) as file:
                file.write(json.dumps(number + 1).encode())
        self._open(place)

    def _key(self, trunk: TorchTrunk, layers: int) -> str:
        digest = hashlib.sha256(f"{self.batches.options} {self.groups} {layers}".encode())
        for image in self.batches.images:
            digest.update(repr(replace(image, rgb=image.rgb.shape)).encode())  # type: ignore[arg-type]
            digest.update(image.rgb.tobytes())
        state = trunk.state_dict()
        for conv, _ in convolutions(trunk.trunk.layers[: trunk.trunk.input_layers + layers], 0):
            for part in ("weight", "bias"):
                digest.update(state[f"{conv.name}.{part}"].float().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()[:24]

    def _open(self, place: Path) -> None:
        self.maps = np.lib.format.open_memmap(place / "maps.npy", mode="r+")
        self.coordinates = np.lib.format.open_memmap(place / "coordinates.npy", mode="r+")

    def mild_maps(self, most: int = 1500) -> Iterable[Tensor]:
        """The first views of at most so many places, evenly drawn: (C', h, w) each."""
        views = self.batches.options.views
        places = len(self.maps) // views
        for row in views * np.unique(np.linspace(0, places - 1, min(most, places)).astype(int)):
            yield torch.from_numpy(np.asarray(self.maps[row]))

    def __getitem__(self, number: int) -> Batch:
        o = self.batches.options
        rng = np.random.default_rng([o.seed, 1, number])
        clusters = o.places // o.neighbours
        chosen = rng.choice(self.groups * clusters, self.places // o.neighbours, replace=False)
        rows = []
        for cluster in chosen:
            group, first = divmod(int(cluster), clusters)
            for place in range(o.neighbours):
                base = (group * o.places + first * o.neighbours + place) * o.views
                rows += [base, *(base + 1 + rng.permutation(o.views - 1)[: self.views - 1])]
        per_group = o.places * o.views
        origins = [self.origins[r // per_group][r % per_group] for r in rows]
        return assembled(origins, torch.from_numpy(self.maps[rows]), [self.coordinates[r] for r in rows])


class _Front:
    """The first `layers` of a trunk for views (H, W, 3) of one size, in OpenVINO: faster than torch here."""

    def __init__(self, trunk: TorchTrunk, layers: int, size: tuple[int, ...]) -> None:
        self.size = size
        weights = {name: tensor.detach().float().cpu().numpy() for name, tensor in trunk.state_dict().items()}
        pixels, images = image_input(size[1], size[0])
        network = trunk.trunk.layers[: trunk.trunk.input_layers + layers]
        graph = ov.Model([build(network, weights, images)], [pixels], "front")
        self._network = Compiled(lambda: graph, torch.get_num_threads())

    def __call__(self, pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(H, W, 3) -> (C', h, w)."""
        return self._network(np.ascontiguousarray(pixels)[None])[0][0]


def _create(path: Path, shape: tuple[int, ...]) -> None:
    np.lib.format.open_memmap(path, mode="w+", dtype=np.float16, shape=shape).flush()

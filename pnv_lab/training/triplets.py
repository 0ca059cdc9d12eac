"""The paper's training: the weakly supervised triplet ranking loss of NetVLAD on hard negatives from a cache.

Settings as published with Patch-NetVLAD (section 4.1 and configs/train.ini). K clusters, C channels.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from pnv_core.describe.netvlad import NetVLAD
from pnv_core.describe.torch_model import TorchTrunk
from pnv_core.errors import ModelError
from pnv_lab.fit import as_batch
from pnv_lab.training.augment import flat_view, relight
from pnv_lab.training.journal import Journal
from pnv_lab.training.losses import TRIPLET_MARGIN, triplet_ranking
from pnv_lab.training.sources import PlaceImage, relation
from pnv_lab.training.validation import ValidationSet, recalls


@dataclass(frozen=True)
class TripletOptions:
    """NetVLAD's training as Patch-NetVLAD ran it."""

    epochs: int = 30
    width: int = 640
    height: int = 480
    tuples: int = 4  # per step
    negatives: int = 5  # per tuple, the hardest
    negative_pool: int = 1000  # images a query's negatives are looked for among
    cache_queries: int = 1000  # after so many the cache is computed anew
    rate: float = 1e-4
    halve_every: int = 5  # epochs
    momentum: float = 0.9
    weight_decay: float = 1e-3
    margin: float = TRIPLET_MARGIN
    first_layer: int = 24  # of VGG16's `features`: conv5_1; what is before it keeps its weights
    seed: int = 123
    mixed: bool = True


@dataclass(frozen=True)
class _Tuple:
    """A query image, its positive (the query itself: an augmented view of it) and its negatives."""

    query: int
    positive: int
    negatives: tuple[int, ...]


class TripletTrainer:
    """Trains a trunk's last layers and its NetVLAD layer. `run` goes on from the last finished cache in `folder`."""

    def __init__(
        self,
        trunk: TorchTrunk,
        netvlad: NetVLAD,
        images: Sequence[PlaceImage],
        validation: Sequence[ValidationSet],
        options: TripletOptions,
        folder: Path,
        device: str = "cpu",
    ) -> None:
        self.images = [i for i in images if not i.panorama]
        if len(self.images) <= options.negatives:
            raise ModelError(f"{len(self.images)} images cannot make tuples; allowed: more than {options.negatives}")
        self.validation, self.options, self.device = validation, options, torch.device(device)
        self.parts = nn.ModuleDict({"trunk": trunk, "netvlad": netvlad}).to(self.device)
        self.parts["trunk"].to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.parts.requires_grad_(True)
        for parameter in trunk.front_parameters(options.first_layer):
            parameter.requires_grad_(False)
        trained = [p for p in self.parts.parameters() if p.requires_grad]
        self.optimizer = torch.optim.SGD(
            trained, lr=options.rate, momentum=options.momentum, weight_decay=options.weight_decay
        )
        self.journal = Journal(folder, json.dumps({"triplet": asdict(options)}, sort_keys=True))
        self.chunk = 0  # finished caches, over all epochs
        state = self.journal.load(self.device)
        if state is not None:
            self.parts.load_state_dict(state["parts"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.chunk = int(state["step"])

    @property
    def chunks_per_epoch(self) -> int:
        return -(-len(self.images) // self.options.cache_queries)

    def run(self, progress: Callable[[Iterator[int], int, int], Iterator[int]] = lambda it, done, total: it) -> None:
        """Train to the last epoch."""
        total = self.options.epochs * self.chunks_per_epoch
        for chunk in progress(iter(range(self.chunk, total)), self.chunk, total):
            epoch, part = divmod(chunk, self.chunks_per_epoch)
            for group in self.optimizer.param_groups:
                group["lr"] = self.options.rate * 0.5 ** (epoch // self.options.halve_every)
            loss, mined = self._train_chunk(epoch, part)
            row: dict[str, Any] = {"step": chunk + 1, "epoch": epoch + 1, "loss": loss, "tuples": mined}
            if part == self.chunks_per_epoch - 1:
                row |= self._validate()
            self.chunk = chunk + 1
            self.journal.log(row)
            self.journal.save(
                {"step": self.chunk, "parts": self.parts.state_dict(), "optimizer": self.optimizer.state_dict()}
            )
        self.parts.eval().requires_grad_(False)

    def _train_chunk(self, epoch: int, part: int) -> tuple[float, int]:
        """One cache: mine its tuples with the network as it is, then learn from them. Mean loss, number of tuples."""
        rng = np.random.default_rng([self.options.seed, epoch])
        order = rng.permutation(len(self.images))
        queries = order[part * self.options.cache_queries : (part + 1) * self.options.cache_queries]
        rng = np.random.default_rng([self.options.seed, epoch, part])
        tuples = self._mine(queries, rng)
        losses = []
        self.parts.train()
        for start in range(0, len(tuples), self.options.tuples):
            batch = tuples[start : start + self.options.tuples]
            loss = torch.stack([self._loss(t, rng) for t in batch]).mean()
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()
            self.optimizer.step()
            losses.append(float(loss.detach()))
        return (float(np.mean(losses)) if losses else 0.0), len(tuples)

    @torch.no_grad()
    def _mine(self, queries: np.ndarray, rng: np.random.Generator) -> list[_Tuple]:
        """For each query the nearest positive and the hardest negatives that violate the margin; none: no tuple."""
        self.parts.eval()
        pool = rng.permutation(len(self.images))[: self.options.negative_pool]
        partners = {
            int(q): [j for j, i in enumerate(self.images) if j != q and relation(self.images[q], i) > 0]
            for q in queries
        }
        needed = sorted({int(i) for i in (*queries, *pool)} | {p for found in partners.values() for p in found})
        cache = dict(zip(needed, torch.cat([self._vlads([self._pixels(i)]) for i in needed]), strict=True))
        tuples = []
        for query, positives in partners.items():
            vector = cache[query]
            nearest = min(positives, key=lambda p: float((vector - cache[p]).square().sum())) if positives else query
            limit = float((vector - cache[nearest]).square().sum()) + self.options.margin
            negatives = [int(n) for n in pool if relation(self.images[query], self.images[int(n)]) < 0]
            distance = {n: float((vector - cache[n]).square().sum()) for n in negatives}
            hard = sorted((n for n in negatives if not positives or distance[n] < limit), key=distance.__getitem__)
            if hard:
                tuples.append(_Tuple(query, nearest, tuple(hard[: self.options.negatives])))
        return tuples

    def _loss(self, chosen: _Tuple, rng: np.random.Generator) -> Tensor:
        query = self._pixels(chosen.query)
        if chosen.positive == chosen.query:
            size = (self.options.width, self.options.height)
            query = relight(flat_view(self.images[chosen.query].rgb, size, 1.0, False, rng).pixels, 1.0, rng)
        vectors = self._vlads([query, self._pixels(chosen.positive), *(self._pixels(n) for n in chosen.negatives)])
        return triplet_ranking(vectors[0], vectors[1:2], vectors[2:], self.options.margin)

    def _pixels(self, number: int) -> np.ndarray:
        rng = np.random.default_rng(0)  # strength 0 draws, but uses nothing
        return flat_view(self.images[number].rgb, (self.options.width, self.options.height), 0.0, False, rng).pixels

    def _vlads(self, pixels: Sequence[np.ndarray]) -> Tensor:
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.options.mixed):
            features = self.parts["trunk"](as_batch(pixels, self.device))
        return self.parts["netvlad"](features.float())

    @torch.no_grad()
    def _validate(self) -> dict[str, float]:
        self.parts.eval()
        found: dict[str, float] = {}
        for known in self.validation:
            q, r = (torch.cat([self._vlads([i]) for i in images]) for images in (known.queries, known.references))
            found |= {f"{known.name} recall@{n}": v for n, v in recalls(q, r, known, (1, 5)).items()}
        return found

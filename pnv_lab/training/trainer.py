"""End-to-end training with a pair loss on global vectors and a contrastive one on patches.

B images, K clusters, C channels, D dimensions, h x w cells.
"""

import json
import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pnv_core.describe.netvlad import NetVLAD
from pnv_core.describe.torch_model import TorchModel
from pnv_core.errors import ModelError
from pnv_lab.training.batches import Batch, Batches
from pnv_lab.training.journal import Journal
from pnv_lab.training.losses import listwise_ap, multi_similarity, patch_contrast
from pnv_lab.training.validation import ValidationSet, describe_all, recalls

LOSSES: dict[str, Callable[[Tensor, Tensor, Tensor], Tensor]] = {"ms": multi_similarity, "ap": listwise_ap}


@dataclass(frozen=True)
class TrainOptions:
    """Settings of a training. Learning rates are peaks of a cosine schedule with a linear start."""

    steps: int = 700
    loss: str = "ms"  # of the global vectors: ms (multi-similarity) or ap (listwise average precision)
    trunk_lr: float = 1.5e-4
    neck_lr: float = 3e-4
    vlad_lr: float = 1e-3
    projection_lr: float = 1e-3
    weight_decay: float = 1e-4
    frozen_layers: int = 16  # leading layers of the trunk that keep their ImageNet weights, at most all but its last
    patch_weight: float = 0.5  # of the patches' loss
    patch_pairs: int = 10  # image pairs of a batch that the patches' loss looks at
    patch_sizes: tuple[int, ...] = (2, 3, 4, 5)  # one drawn per step
    patch_temperature: float = 0.07
    anchor: float = 0.0  # pull of the trunk towards where it started (L2-SP, Li et al., ICML 2018)
    average: float = 0.995  # decay of the running average of weights that is kept
    blend: float = 0.5  # share of the trained weights in what is given, the rest is the start (WiSE-FT, CVPR 2022)
    warmup: int = 50
    validate_every: int = 350
    save_every: int = 50
    workers: int = 2  # threads that make batches
    mixed: bool = True  # bfloat16 where the trunk computes
    seed: int = 0


class Trainer:
    """Trains a model's every part. `run` goes on from the checkpoint in `folder`, if there is one.

    Averaged weights are what is validated and given.
    """

    def __init__(
        self,
        model: TorchModel,
        batches: Batches,
        validation: Sequence[ValidationSet],
        options: TrainOptions,
        folder: Path,
        device: str = "cpu",
        settings: dict[str, Any] | None = None,
    ) -> None:
        self.model, self.batches, self.validation = model, batches, validation
        self.options = options
        self.device = torch.device(device)
        self.frozen_layers = min(options.frozen_layers, model.trunk.depth - 1)
        if options.loss not in LOSSES:
            raise ModelError(f"loss {options.loss!r} is none; allowed: {', '.join(LOSSES)}")
        if model.patch_projection is None or model.pooled_projection is None:
            raise ModelError("the model lacks a patch or a pooled projection; allowed here: a model that has both")
        self.parts = nn.ModuleDict(
            {
                "trunk": model.trunk,
                "netvlad": model.netvlad,
                "whole": model.global_projection,
                "parts": model.patch_projection,
                "pooled": model.pooled_projection,
                **({} if model.middle_projection is None else {"middle": model.middle_projection}),
            }
        ).to(self.device)
        self.parts["trunk"].to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._freeze()
        self.start = {n: p.detach().clone() for n, p in self.parts.named_parameters()}
        self.average = {n: p.detach().clone() for n, p in self.parts.named_parameters()}
        self.optimizer = torch.optim.AdamW(self._groups(), weight_decay=options.weight_decay)
        self.schedule = torch.optim.lr_scheduler.LambdaLR(self.optimizer, self._rate)
        self.step = 0
        self.journal = Journal(folder, json.dumps({"train": asdict(options), **(settings or {})}, sort_keys=True))
        self._resume()

    def run(
        self, progress: Callable[[Iterator[Batch], int, int], Iterator[Batch]] = lambda batches, done, total: batches
    ) -> TorchModel:
        """Train to the last step and give the model with averaged weights, blended with those it started from."""
        torch.manual_seed(self.options.seed)
        if self.step == 0:
            self._validate()
        totals: dict[str, float] = {}
        batches = prefetched(self.batches, range(self.step, self.options.steps), self.options.workers)
        for batch in progress(batches, self.step, self.options.steps):
            for name, value in self._update(batch).items():
                totals[name] = totals.get(name, 0.0) + value / self.options.save_every
            self.step += 1
            if self.step % self.options.save_every == 0 or self.step == self.options.steps:
                self.journal.log({"step": self.step, "rate": self.schedule.get_last_lr()[0], **totals})
                totals = {}
                self._save()
            if self.step % self.options.validate_every == 0 or self.step == self.options.steps:
                self._validate()
        with torch.no_grad():
            for name, parameter in self.parts.named_parameters():
                parameter.copy_(self.start[name].lerp(self.average[name], self.options.blend))
        for part in self.parts.values():
            part.eval().requires_grad_(False)
        return self.model

    def _freeze(self) -> None:
        for parameter in self.parts.parameters():
            parameter.requires_grad_(True)
        for parameter in self.model.trunk.front_parameters(self.frozen_layers):
            parameter.requires_grad_(False)

    def _groups(self) -> list[dict[str, Any]]:
        o = self.options
        rates = {
            "trunk.neck": o.neck_lr,
            "trunk": o.trunk_lr,
            "netvlad": o.vlad_lr,
            "whole": o.projection_lr,
            "parts": o.projection_lr,
            "pooled": o.projection_lr,
            "middle": o.projection_lr,
        }
        left = {n: p for n, p in self.parts.named_parameters() if p.requires_grad}
        groups = []
        for prefix, rate in rates.items():
            chosen = [p for n, p in left.items() if n.startswith(prefix)]
            left = {n: p for n, p in left.items() if not n.startswith(prefix)}
            if chosen:
                groups.append({"params": chosen, "lr": rate})
        return groups

    def _rate(self, step: int) -> float:
        if step < self.options.warmup:
            return (step + 1) / self.options.warmup
        done = (step - self.options.warmup) / max(1, self.options.steps - self.options.warmup)
        return 0.02 + 0.98 * (1 + math.cos(math.pi * min(done, 1.0))) / 2

    def _update(self, batch: Batch) -> dict[str, float]:
        self.parts.train()
        features, *maps = self._maps(batch.inputs.to(self.device))
        x, weights = self.model.netvlad.soft_assign(features)
        vectors = self.model.global_vector(self.model.netvlad.vlad(x, weights), *maps)
        whole = LOSSES[self.options.loss](vectors, batch.positive.to(self.device), batch.negative.to(self.device))
        parts = self._patch_loss(batch, x, weights, (features.shape[-2], features.shape[-1]))
        loss = whole + self.options.patch_weight * parts
        if self.options.anchor:
            drift = sum(
                (p - self.start[n]).square().sum()
                for n, p in self.parts.named_parameters()
                if n.startswith("trunk") and p.requires_grad
            )
            loss = loss + self.options.anchor * drift
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.parts.parameters(), 1.0)
        self.optimizer.step()
        self.schedule.step()
        decay = min(self.options.average, (self.step + 1) / (self.step + 10))
        with torch.no_grad():
            for name, parameter in self.parts.named_parameters():
                if parameter.requires_grad:
                    self.average[name].lerp_(parameter, 1 - decay)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise ModelError(f"the loss is {value} at step {self.step}; lower the learning rates")
        return {"loss": value, "global_loss": float(whole.detach()), "patch_loss": float(parts.detach())}

    def _maps(self, inputs: Tensor) -> list[Tensor]:
        """The trunk's maps of images, or of what the frozen layers gave for them."""
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.options.mixed):
            if inputs.dtype == torch.uint8:
                found = self.model.trunk.maps((inputs.float() / 255).contiguous(memory_format=torch.channels_last))
            else:
                maps = inputs.float().contiguous(memory_format=torch.channels_last)
                found = self.model.trunk.back(maps, self.frozen_layers)
        return [maps.float() for maps in found]

    def _patch_loss(self, batch: Batch, x: Tensor, weights: Tensor, shape: tuple[int, int]) -> Tensor:
        """Mean over some image pairs of one scene, at one patch size."""
        generator = torch.Generator().manual_seed(self.options.seed * 1_000_003 + self.step)
        same = (batch.scene[:, None] == batch.scene[None]) & batch.positive
        pairs = torch.nonzero(torch.triu(same, 1))
        pairs = pairs[torch.randperm(len(pairs), generator=generator)[: self.options.patch_pairs]]
        if not len(pairs) or not self.options.patch_weight:
            return x.sum() * 0.0
        size = self.options.patch_sizes[int(torch.randint(len(self.options.patch_sizes), (1,), generator=generator))]
        used, where = pairs.unique(return_inverse=True)
        descriptors = patch_vectors(self.model.netvlad, x[used], weights[used], shape, size)  # (B', n, K * C)
        descriptors = self.parts["parts"](descriptors)
        places = (
            F.avg_pool2d(batch.coordinates[used].permute(0, 3, 1, 2).to(self.device), size, 1)
            .flatten(2)
            .transpose(1, 2)
        )
        losses = [
            patch_contrast(
                descriptors[a],
                descriptors[b],
                places[a],
                places[b],
                radius=1.5,
                temperature=self.options.patch_temperature,
            )
            for a, b in where.tolist()
        ]
        return torch.stack(losses).mean()

    def _validate(self) -> None:
        """Log recall of the running average on every validation set."""
        self.parts.eval()
        now = {n: p.detach().clone() for n, p in self.parts.named_parameters()}
        self._use_average()
        found: dict[str, float] = {}
        for known in self.validation:
            q, r = (
                describe_all(self.model, images, self.device, self.options.mixed)
                for images in (known.queries, known.references)
            )
            found |= {f"{known.name} recall@{n}": value for n, value in recalls(q, r, known, (1, 5)).items()}
        self.journal.log({"step": self.step, **found})
        with torch.no_grad():
            for name, parameter in self.parts.named_parameters():
                parameter.copy_(now[name])

    def _use_average(self) -> None:
        with torch.no_grad():
            for name, parameter in self.parts.named_parameters():
                parameter.copy_(self.average[name])

    def _save(self) -> None:
        state = {
            "step": self.step,
            "parts": self.parts.state_dict(),
            "average": self.average,
            "start": self.start,
            "optimizer": self.optimizer.state_dict(),
            "schedule": self.schedule.state_dict(),
        }
        self.journal.save(state)

    def _resume(self) -> None:
        state = self.journal.load(self.device)
        if state is None:
            return
        self.parts.load_state_dict(state["parts"])
        self.average, self.start = state["average"], state["start"]
        self.optimizer.load_state_dict(state["optimizer"])
        self.schedule.load_state_dict(state["schedule"])
        self.step = int(state["step"])


def patch_vectors(netvlad: NetVLAD, x: Tensor, weights: Tensor, shape: tuple[int, int], size: int) -> Tensor:
    """Patch VLADs with gradients, for small maps: x (B, C, N), weights (B, K, N) -> (B, n, K * C) unit rows."""
    residuals = weights[:, :, None] * (x[:, None] - netvlad.centroids[None, :, :, None])  # (B, K, C, N)
    b, k, c, _ = residuals.shape
    sums = F.avg_pool2d(residuals.reshape(b, k * c, *shape), size, 1).flatten(2).transpose(1, 2)  # (B, n, K * C)
    vlad = F.normalize(sums.reshape(b, -1, k, c), dim=3, eps=1e-6).flatten(2)
    return F.normalize(vlad, dim=2)


def prefetched(batches: Batches, numbers: range, workers: int) -> Iterator[Batch]:
    """The batches in order, made ahead of time by `workers` threads (OpenCV works outside the interpreter's lock)."""
    with ThreadPoolExecutor(workers) as pool:
        ahead: deque[Future[Batch]] = deque()
        rest = iter(numbers)
        for number in islice(rest, 2 * workers):
            ahead.append(pool.submit(batches.__getitem__, number))
        while ahead:
            done = ahead.popleft().result()
            ahead.extend(pool.submit(batches.__getitem__, number) for number in islice(rest, 1))
            yield done

"""Model files: one safetensors file holds trunk, NetVLAD layer, projections and what is known about them.

K clusters, C channels, D dimensions.
"""

import hashlib
import json
import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as safetensors_bytes
from torch import Tensor

from pnv_core.describe.netvlad import NetVLAD, Projection, gem
from pnv_core.describe.trunks import TRUNKS
from pnv_core.describe.trunks.trunk import Trunk
from pnv_core.errors import ModelError
from pnv_core.files import atomic_write

FORMAT = "pnv-model-1"

_OPTIONAL = ("patch_projection", "pooled_projection")


@dataclass(frozen=True)
class ModelInfo:
    """What a model file says of itself. Sizes in pixels; `patch_sizes` in cells of the trunk."""

    trunk: str
    trunk_options: dict[str, Any] = field(default_factory=dict)
    image_width: int = 640
    image_height: int = 480
    patch_sizes: tuple[int, ...] = (2, 5, 8)
    patch_weights: tuple[float, ...] = (0.45, 0.15, 0.4)
    provenance: str = ""
    calibration: dict[str, Any] | None = None


@dataclass(frozen=True, eq=False)
class Model:
    """A describing network. Without `patch_projection` patches share the global one, as in the paper.

    With `pooled_projection` the global vector is the projected VLAD beside the projected generalised mean of the map
    before the trunk's neck, with equal weights: it keeps how strongly features respond, which VLAD's unit local
    descriptors do not. Without it (every published model) the global vector is the projected VLAD.
    """

    info: ModelInfo
    trunk: Trunk
    netvlad: NetVLAD
    global_projection: Projection
    patch_projection: Projection | None = None
    pooled_projection: Projection | None = None

    def global_vector(self, vlad: Tensor, wide: Tensor, cells: Tensor | None = None) -> Tensor:
        """VLADs (B, K * C) and the maps before the trunk's neck (B, W, h, w) -> unit global vectors (B, D).

        `cells` (B, N) say how much each cell counts.
        """
        vector: Tensor = self.global_projection(vlad)
        if self.pooled_projection is None:
            return vector
        return torch.cat([vector, self.pooled_projection(gem(wide, cells))], dim=1) * math.sqrt(0.5)

    @property
    def patches_projection(self) -> Projection:
        return self.patch_projection or self.global_projection

    @property
    def global_dim(self) -> int:
        pooled = 0 if self.pooled_projection is None else self.pooled_projection.weight.shape[0]
        return self.global_projection.weight.shape[0] + pooled

    @property
    def patch_dim(self) -> int:
        return self.patches_projection.weight.shape[0]

    def tensors(self) -> dict[str, Tensor]:
        """Every learned tensor by its name in the file."""
        parts = {"trunk": self.trunk, "netvlad": self.netvlad, "global_projection": self.global_projection}
        for name in _OPTIONAL:
            if (part := getattr(self, name)) is not None:
                parts[name] = part
        return {f"{part}.{k}": v.detach() for part, module in parts.items() for k, v in module.state_dict().items()}

    def fingerprint(self) -> str:
        """sha256 over the tensors (float32) and the trunk's name: equal fingerprints describe alike."""
        digest = hashlib.sha256(json.dumps([self.info.trunk, self.info.trunk_options], sort_keys=True).encode())
        for name, tensor in sorted(self.tensors().items()):
            digest.update(f"{name}{tuple(tensor.shape)}".encode())
            digest.update(tensor.float().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()

    def with_info(self, **changes: Any) -> "Model":
        return replace(self, info=replace(self.info, **changes))


def build_model(info: ModelInfo, tensors: dict[str, Tensor], source: str) -> Model:
    """A Model from named tensors; K, C and D come from the shapes. Raises ModelError naming `source` and the fault."""
    groups: dict[str, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        part, _, rest = name.partition(".")
        groups.setdefault(part, {})[rest] = tensor.float()
    required = {"netvlad", "global_projection"}
    if set(groups) - {"trunk", *_OPTIONAL} != required:
        raise ModelError(
            f"{source}: holds the parts {sorted(groups)}; allowed: trunk, {', '.join(sorted((*required, *_OPTIONAL)))}"
        )
    trunk = TRUNKS.make(info.trunk, **info.trunk_options)
    centroids = groups["netvlad"].get("centroids")
    if centroids is None or centroids.ndim != 2 or centroids.shape[1] != trunk.channels:
        shape = None if centroids is None else tuple(centroids.shape)
        raise ModelError(f"{source}: netvlad.centroids has shape {shape}; allowed: (K, {trunk.channels})")
    clusters = centroids.shape[0]
    netvlad = NetVLAD(clusters, trunk.channels)
    projections = {}
    for part in ("global_projection", *_OPTIONAL):
        if part in groups:
            bias = groups[part].get("bias")
            if bias is None or bias.ndim != 1:
                raise ModelError(f"{source}: {part}.bias is missing or no vector; allowed: (D,)")
            inputs = trunk.width if part == "pooled_projection" else clusters * trunk.channels
            projections[part] = Projection(inputs, bias.shape[0])
    for part, module in {"trunk": trunk, "netvlad": netvlad, **projections}.items():
        _load_exactly(module, groups.get(part, {}), f"{source}: {part}")
    model = Model(info, trunk, netvlad, **projections)
    for module in (trunk, netvlad, *projections.values()):
        module.eval().requires_grad_(False)
    return model


def _load_exactly(module: torch.nn.Module, tensors: dict[str, Tensor], what: str) -> None:
    expected = {name: tuple(t.shape) for name, t in module.state_dict().items()}
    given = {name: tuple(t.shape) for name, t in tensors.items()}
    if missing := sorted(set(expected) - set(given)):
        raise ModelError(f"{what} lacks {', '.join(missing[:4])}{' ...' if len(missing) > 4 else ''}")
    if extra := sorted(set(given) - set(expected)):
        raise ModelError(f"{what} has unexpected {', '.join(extra[:4])}{' ...' if len(extra) > 4 else ''}")
    for name, shape in expected.items():
        if given[name] != shape:
            raise ModelError(f"{what}.{name} has shape {given[name]}; allowed: {shape}")
        if not torch.isfinite(tensors[name]).all():
            raise ModelError(f"{what}.{name} holds values that are not finite")
    module.load_state_dict(tensors, strict=True)


def save_model(model: Model, path: Path | str, dtype: torch.dtype = torch.float32) -> None:
    """Write `model` atomically, tensors as `dtype` (float16 halves the file)."""
    tensors = {name: t.to(dtype).cpu().contiguous() for name, t in model.tensors().items()}
    stored = build_model(model.info, tensors, str(path))  # the fingerprint is that of the values in the file
    metadata = {
        "format": FORMAT,
        "clusters": model.netvlad.clusters,
        "global_dim": model.global_dim,
        "patch_dim": model.patch_dim,
        "fingerprint": stored.fingerprint(),
        **asdict(model.info),
    }
    blob = safetensors_bytes(tensors, {k: v if isinstance(v, str) else json.dumps(v) for k, v in metadata.items()})
    with atomic_write(path) as file:
        file.write(blob)


def load_model(path: Path | str) -> Model:
    """Read a model file. Raises ModelError for anything else, naming what is wrong."""
    source = str(path)
    try:
        with safe_open(source, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    except FileNotFoundError:
        raise ModelError(f"{source}: no such model file") from None
    except (SafetensorError, OSError) as error:
        raise ModelError(f"{source}: not a readable safetensors file ({error})") from None
    if metadata.get("format") != FORMAT:
        raise ModelError(f"{source}: format {metadata.get('format')!r}; allowed: {FORMAT!r}")
    try:
        info = ModelInfo(
            trunk=metadata["trunk"],
            trunk_options=json.loads(metadata["trunk_options"]),
            image_width=int(metadata["image_width"]),
            image_height=int(metadata["image_height"]),
            patch_sizes=tuple(int(p) for p in json.loads(metadata["patch_sizes"])),
            patch_weights=tuple(float(w) for w in json.loads(metadata["patch_weights"])),
            provenance=metadata["provenance"],
            calibration=json.loads(metadata.get("calibration", "null")),
        )
    except (KeyError, ValueError, TypeError) as error:
        raise ModelError(f"{source}: metadata is incomplete or malformed ({error})") from None
    model = build_model(info, tensors, source)
    if model.fingerprint() != metadata.get("fingerprint"):
        raise ModelError(f"{source}: the tensors do not match their fingerprint; the file was altered or damaged")
    return model

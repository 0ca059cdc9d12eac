"""Model files: one safetensors file holds trunk, NetVLAD layer, projections and what is known about them.

K clusters, C channels, D dimensions.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import DTypeLike, NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as safetensors_bytes

from pnv_core.describe.trunks import TRUNKS
from pnv_core.describe.trunks.trunk import Trunk
from pnv_core.errors import ModelError
from pnv_core.files import atomic_write

FORMAT = "pnv-model-1"
_MOST_TEXT = 100_000  # characters of a text in the metadata
_MOST_SIZES = 16
BESIDE = {"pooled_projection": "pooled_share", "middle_projection": "middle_share"}
"""Parts of the global vector beside the VLAD, and what their share of the cosine is called."""
OPTIONAL = ("patch_projection", *BESIDE)

Tensors = Mapping[str, NDArray[np.float32]]


class _Stored(Mapping[str, NDArray[np.float32]]):
    """The tensors of a file, read when they are asked for: once it is compiled, a network needs them no more."""

    def __init__(self, path: str) -> None:
        """Raises what safetensors raises."""
        self._path = path
        self._file: Any = safe_open(path, framework="np")
        self.metadata = self._file.metadata() or {}
        self._names = sorted(self._file.keys())

    def close(self) -> None:
        """Until a tensor is asked for again."""
        self._file = None

    def __getitem__(self, name: str) -> NDArray[np.float32]:
        if name not in self._names:
            raise KeyError(name)
        if self._file is None:
            self._file = safe_open(self._path, framework="np")
        return np.ascontiguousarray(self._file.get_tensor(name), np.float32)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


@dataclass(frozen=True)
class ModelInfo:
    """What a model file says of itself. Sizes in pixels; `patch_sizes` in cells of the trunk."""

    trunk: str
    trunk_options: dict[str, Any] = field(default_factory=dict)
    image_width: int = 640
    image_height: int = 480
    patch_sizes: tuple[int, ...] = (2, 5, 8)
    patch_weights: tuple[float, ...] = (0.45, 0.15, 0.4)
    pooled_share: float = 0.5  # of the cosine of two global vectors, where a part of them is pooled
    middle_share: float = 0.0  # the same of what is pooled of the maps before the neck
    provenance: str = ""
    calibration: dict[str, Any] | None = None


@dataclass(frozen=True, eq=False)
class Model:
    """A describing network: what its file says and its tensors in float32, by name, as `build_model` checks them.

    Without the part `patch_projection` patches share the global one, as in the paper. With `pooled_projection` the
    global vector is the projected VLAD beside the projected generalised mean of the map that the trunk has for
    it, with `middle_projection` beside that of the map before the neck, weighed by their shares: they keep how strongly
    features respond, which VLAD's unit local descriptors do not. Without them (every published model) the global vector
    is the projected VLAD.
    """

    info: ModelInfo
    tensors: Tensors

    @cached_property
    def trunk(self) -> Trunk:
        return TRUNKS.make(self.info.trunk, **self.info.trunk_options)

    def part(self, name: str) -> Tensors:
        """The tensors of one part, by their names within it."""
        return {n.partition(".")[2]: t for n, t in self.tensors.items() if n.partition(".")[0] == name}

    def has(self, part: str) -> bool:
        return any(name.startswith(f"{part}.") for name in self.tensors)

    @cached_property
    def clusters(self) -> int:
        return len(self.tensors["netvlad.centroids"])

    @property
    def patches_projection(self) -> str:
        """The part that projects patches."""
        return "patch_projection" if self.has("patch_projection") else "global_projection"

    @property
    def shares(self) -> dict[str, float]:
        """The parts that the global vector is made of, in order, and the share of each in the cosine."""
        return shares_of(self.info, [part for part in BESIDE if self.has(part)])

    @cached_property
    def global_dim(self) -> int:
        return sum(len(self.tensors[f"{part}.bias"]) for part in self.shares)

    @cached_property
    def patch_dim(self) -> int:
        return len(self.tensors[f"{self.patches_projection}.bias"])

    def release(self) -> None:
        """Give back the memory of tensors that a file has; they are read again where somebody asks for them."""
        if isinstance(self.tensors, _Stored):
            _ = self.clusters, self.global_dim, self.patch_dim  # kept, so that no later question opens the file again
            self.tensors.close()

    def fingerprint(self) -> str:
        """sha256 over the tensors, the trunk's name and the parts' shares: equal fingerprints describe alike."""
        share = [] if self.info.pooled_share == 0.5 else [self.info.pooled_share]
        middle = [self.info.middle_share] if self.info.middle_share else []
        kind = [self.info.trunk, self.info.trunk_options, *share, *middle]
        digest = hashlib.sha256(json.dumps(kind, sort_keys=True).encode())
        for name, tensor in sorted(self.tensors.items()):
            digest.update(f"{name}{tuple(tensor.shape)}".encode())
            digest.update(np.ascontiguousarray(tensor, "<f4").data)
        return digest.hexdigest()

    def with_info(self, **changes: Any) -> "Model":
        return replace(self, info=replace(self.info, **changes))


def shares_of(info: ModelInfo, beside: Sequence[str]) -> dict[str, float]:
    """The share in the cosine of the projected VLAD and of the parts `beside` it."""
    found = {part: getattr(info, BESIDE[part]) for part in beside}
    return {"global_projection": max(1.0 - sum(found.values()), 0.0), **found}


def build_model(info: ModelInfo, tensors: Mapping[str, NDArray], source: str) -> Model:
    """A Model from named tensors; K, C and D come from the shapes. Raises ModelError naming `source` and the fault."""
    if not isinstance(tensors, _Stored):
        tensors = {name: np.ascontiguousarray(tensor, np.float32) for name, tensor in tensors.items()}
    model = Model(info, tensors)
    parts = {name.partition(".")[0] for name in tensors}
    required = {"netvlad", "global_projection"}
    if parts - {"trunk", *OPTIONAL} != required:
        raise ModelError(
            f"{source}: holds the parts {sorted(parts)}; allowed: trunk, {', '.join(sorted((*required, *OPTIONAL)))}"
        )
    try:
        trunk = model.trunk
    except (TypeError, ValueError, OverflowError, AttributeError) as error:
        if isinstance(error, ModelError):
            raise
        raise ModelError(f"{source}: trunk_options {info.trunk_options} do not make a {info.trunk} ({error})") from None
    centroids = model.tensors.get("netvlad.centroids")
    if centroids is None or centroids.ndim != 2 or centroids.shape[1] != trunk.channels:
        shape = None if centroids is None else tuple(centroids.shape)
        raise ModelError(f"{source}: netvlad.centroids has shape {shape}; allowed: (K, {trunk.channels})")
    expected = {"trunk": trunk.tensor_shapes()}
    expected["netvlad"] = {"assignment": centroids.shape, "centroids": centroids.shape}
    for part in ("global_projection", *OPTIONAL):
        if part in parts:
            bias = model.tensors.get(f"{part}.bias")
            if bias is None or bias.ndim != 1:
                raise ModelError(f"{source}: {part}.bias is missing or no vector; allowed: (D,)")
            inputs = {"pooled_projection": trunk.pooled_width, "middle_projection": trunk.width}.get(
                part, centroids.size
            )
            expected[part] = {"bias": bias.shape, "weight": (len(bias), inputs)}
    if sum(model.shares.values()) > 1.0 + 1e-6:
        raise ModelError(f"{source}: pooled_share + middle_share = {sum(model.shares.values()):g}; allowed: up to 1")
    for part, shapes in expected.items():
        _check_exactly(shapes, model.part(part), f"{source}: {part}")
    return model


def _check_exactly(expected: Mapping[str, tuple[int, ...]], tensors: Tensors, what: str) -> None:
    if missing := sorted(set(expected) - set(tensors)):
        raise ModelError(f"{what} lacks {', '.join(missing[:4])}{' ...' if len(missing) > 4 else ''}")
    if extra := sorted(set(tensors) - set(expected)):
        raise ModelError(f"{what} has unexpected {', '.join(extra[:4])}{' ...' if len(extra) > 4 else ''}")
    for name, shape in expected.items():
        if tensors[name].shape != shape:
            raise ModelError(f"{what}.{name} has shape {tensors[name].shape}; allowed: {shape}")
        if not np.isfinite(tensors[name]).all():
            raise ModelError(f"{what}.{name} holds values that are not finite")


def save_model(model: Model, path: Path | str, dtype: DTypeLike = np.float32) -> None:
    """Write `model` atomically, tensors as `dtype` (float16 halves the file)."""
    tensors = {name: np.ascontiguousarray(tensor, dtype) for name, tensor in model.tensors.items()}
    stored = build_model(model.info, tensors, str(path))  # the fingerprint is that of the values in the file
    metadata = {
        "format": FORMAT,
        "clusters": model.clusters,
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
        tensors = _Stored(source)
        for name in tensors:  # one of another kind of number is refused here
            _ = tensors[name]
    except FileNotFoundError:
        raise ModelError(f"{source}: no such model file") from None
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise ModelError(f"{source}: not a readable safetensors file ({error})") from None
    metadata = tensors.metadata
    if metadata.get("format") != FORMAT:
        raise ModelError(f"{source}: format {metadata.get('format')!r}; allowed: {FORMAT!r}")
    info = _info(metadata, source)
    model = build_model(info, tensors, source)
    if model.fingerprint() != metadata.get("fingerprint"):
        raise ModelError(f"{source}: the tensors do not match their fingerprint; the file was altered or damaged")
    return model


_Side = Annotated[int, msgspec.Meta(ge=16, le=8192)]
_Size = Annotated[int, msgspec.Meta(ge=1, le=64)]
_Weight = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
_Option = bool | int | float | str | None


def _info(metadata: dict[str, str], source: str) -> ModelInfo:
    """What the metadata says, each part of its type and within its bounds. Raises ModelError."""

    def part(name: str, kind: Any) -> Any:
        try:
            return msgspec.json.decode(metadata[name].encode("utf-8", "replace"), type=kind)
        except KeyError:
            raise ModelError(f"{source}: its metadata lacks {name}") from None
        except (msgspec.DecodeError, RecursionError) as error:
            raise ModelError(f"{source}: {name} in its metadata is malformed ({error})") from None

    for name in ("trunk", "provenance"):
        if len(metadata.get(name, "")) > _MOST_TEXT:
            raise ModelError(f"{source}: {name} in its metadata has {len(metadata[name])} characters")
    sizes = part("patch_sizes", tuple[_Size, ...])
    weights = part("patch_weights", tuple[_Weight, ...])
    if not sizes or len(sizes) != len(weights) or len(sizes) > _MOST_SIZES:
        raise ModelError(f"{source}: {len(sizes)} patch sizes and {len(weights)} weights; allowed: as many, 1 to 16")
    calibration = part("calibration", dict[str, Any] | None) if "calibration" in metadata else None
    return ModelInfo(
        trunk=metadata.get("trunk", ""),
        trunk_options=part("trunk_options", dict[str, _Option]),
        image_width=part("image_width", _Side),
        image_height=part("image_height", _Side),
        patch_sizes=sizes,
        patch_weights=weights,
        pooled_share=part("pooled_share", _Weight) if "pooled_share" in metadata else ModelInfo.pooled_share,
        middle_share=part("middle_share", _Weight) if "middle_share" in metadata else ModelInfo.middle_share,
        provenance=metadata.get("provenance", ""),
        calibration=calibration,
    )

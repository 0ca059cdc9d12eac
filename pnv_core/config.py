"""Config of the recogniser: each setting declared once. Presets are sets of defaults."""

import dataclasses
from dataclasses import dataclass
from typing import Any

from pnv_core.errors import ConfigError
from pnv_core.settings import Section, checked, setting, settings_of

# What a preset sets when the user does not: patch geometry, scorer, input size and the file taken when none is named.
# performance, speed and storage are the published configurations (Patch-NetVLAD repository, configs/*.ini); balanced
# lies between them: several sizes and RANSAC at a smaller D. The paper draws a single size there, its D is not printed.
_PUBLISHED: dict[str, Any] = {
    "image_width": 640,
    "image_height": 480,
    "patch_precision": "float32",
}
_SEVERAL_SIZES = _PUBLISHED | {
    "patch_sizes": (2, 5, 8),
    "patch_strides": (1, 1, 1),
    "patch_weights": (0.45, 0.15, 0.4),
    "scorer": "ransac",
}
_ONE_SIZE = _PUBLISHED | {
    "patch_sizes": (5,),
    "patch_strides": (1,),
    "patch_weights": (1.0,),
    "scorer": "rapid",
}
PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "performance": _SEVERAL_SIZES | {"weights": "mapillary_WPCA4096"},
    "balanced": _SEVERAL_SIZES | {"weights": "mapillary_WPCA512"},
    "speed": _ONE_SIZE | {"weights": "mapillary_WPCA512"},
    "storage": _ONE_SIZE | {"weights": "mapillary_WPCA128"},
}


@dataclass(frozen=True)
class Config:
    """Settings of the recogniser. `Config.make` applies a preset; every instance is valid or raises ConfigError."""

    preset: str = setting("default", "set of defaults for everything below", choices=tuple(PRESETS))

    _describing = Section("Describing")
    weights: str = setting("default", "model: 'default' (in the package), a published name, or a file")
    device: str = setting("cpu", "where the network runs", choices=("cpu", "cuda", "auto"))
    backend: str = setting(
        "auto",
        "library the network runs in; auto: openvino on the processor, torch on cuda",
        choices=("auto", "openvino", "torch"),
    )
    trunk_precision: str = setting(
        "auto",
        "arithmetic of the describing network after its first layers; auto: bfloat16 for EfficientNet-Lite in OpenVINO "
        "where the processor multiplies it natively, else float32",
        choices=("auto", "float32", "bfloat16"),
    )
    threads: int = setting(
        2,
        "threads of the networks: with verification half for the descriptor, half for local features; 0 = all cores",
        low=0,
        high=256,
    )
    image_width: int = setting(
        0, "width the image is resized to; 0 = as the model was trained", unit="px", low=0, high=8192
    )
    image_height: int = setting(
        0, "height the image is resized to; 0 = as the model was trained", unit="px", low=0, high=8192
    )
    patch_sizes: tuple[int, ...] = setting(
        (), "patch sizes; empty = the model's", kind=int, unit="cells of the feature map", low=1, high=64
    )
    patch_strides: tuple[int, ...] = setting(
        (), "stride per patch size; empty = 1", kind=int, unit="cells", low=1, high=16
    )
    patch_weights: tuple[float, ...] = setting(
        (), "fusion weight per patch size, sum 1; empty = the model's", kind=float, low=0.0, high=1.0
    )

    _keyframes = Section("Keyframes")
    min_interval_s: float = setting(0.5, "least time between keyframes", unit="s", low=0.0, high=1e6, live=True)
    min_change: float = setting(
        0.05, "least change between keyframes: 1 - cosine of the global vectors", low=0.0, high=2.0, live=True
    )

    _retrieval = Section("Retrieval")
    exclude_recent_s: float = setting(
        30.0, "keyframes younger than this are no candidates", unit="s", low=0.0, high=1e6, live=True
    )
    candidates: int = setting(10, "keyframes re-ranked per query", low=1, high=1000, live=True)
    time_budget_ms: float = setting(
        0.0, "re-rank fewer candidates rather than exceed this; 0 = no budget", unit="ms", low=0.0, high=1e6, live=True
    )
    index: str = setting("auto", "index of the global vectors: auto, exact, pq, or a registered name")

    _reranking = Section("Re-ranking")
    scorer: str = setting(
        "usac",
        "spatial score of patch matches: ransac as the authors run it, usac far sooner, rapid without a geometry",
        choices=("usac", "ransac", "rapid"),
    )
    verifier: str = setting(
        "xfeat", "what examines the best candidates beside their patches: xfeat, or a registered name"
    )
    verify: int = setting(
        5,
        "best candidates examined by local features; 0 = none, and neither features nor pictures are kept",
        low=0,
        high=100,
    )

    _decision = Section("Decision")
    accept_score: float = setting(0.5, "least calibrated score of an accepted closure", low=0.0, high=1.0, live=True)
    min_texture: float = setting(0.05, "images with less texture than this close no loop", low=0.0, high=1.0, live=True)
    consistency: int = setting(3, "neighbouring keyframes that must agree; 0 = none", low=0, high=50, live=True)
    sure_score: float = setting(
        0.6,
        "a closure of at least this score needs no neighbours; above 1 = none is sure",
        low=0.0,
        high=1.1,
        live=True,
    )
    odometry_drift: float = setting(
        0.1,
        "error of odometry per metre gone, where odometry is given; a closure farther off is refused",
        low=0.0,
        high=10.0,
        live=True,
    )
    odometry_slack_m: float = setting(
        10.0, "how far apart two views of one place may lie; a fifth of it in height", unit="m", low=0.0, live=True
    )
    min_travelled_m: float = setting(
        1.0, "least way gone between two visits, where odometry is given", unit="m", low=0.0, live=True
    )

    _memory = Section("Memory")
    memory_budget_mb: float = setting(
        1024.0, "bound on descriptors, patches and index together", unit="MB", low=1.0, high=1e7
    )
    eviction: str = setting("oldest", "what goes when the budget is full", choices=("oldest", "densest"))
    patch_store: str = setting("memory", "where patches of old keyframes live", choices=("memory", "disk"))
    patch_folder: str = setting("", "folder of the patches on disk; empty = /var/tmp")
    disk_budget_gb: float = setting(32.0, "bound on the patches on disk", unit="GB", low=0.0, high=1e6)
    patch_precision: str = setting("int8", "precision of stored patches", choices=("float32", "float16", "int8"))

    def __post_init__(self) -> None:
        checked(self)
        n = len(self.patch_sizes)
        for name in ("patch_strides", "patch_weights"):
            given = getattr(self, name)
            if given and len(given) != n:
                raise ConfigError(f"{name} = {given} has {len(given)} entries; patch_sizes has {n}")
        if self.patch_weights and abs(sum(self.patch_weights) - 1.0) > 1e-6:
            raise ConfigError(
                f"patch_weights = {self.patch_weights} sum to {sum(self.patch_weights):g}; allowed: a sum of 1"
            )

    @classmethod
    def make(cls, preset: str = "default", **overrides: Any) -> "Config":
        """A preset with overrides. Raises ConfigError for an unknown preset, name or value."""
        if preset not in PRESETS:
            raise ConfigError(f"preset = {preset!r} is out of range; allowed: one of {', '.join(PRESETS)}")
        unknown = set(overrides) - set(settings_of(cls))
        if unknown:
            raise ConfigError(f"{', '.join(sorted(unknown))} is no setting; allowed: {', '.join(settings_of(cls))}")
        given = PRESETS[preset] | overrides
        if "patch_sizes" in overrides:  # a new set of sizes takes its own strides and weights
            given = {k: v for k, v in given.items() if k in overrides or k not in ("patch_strides", "patch_weights")}
        return cls(preset=preset, **given)

    def replace(self, **changes: Any) -> "Config":
        return dataclasses.replace(self, **changes)


def live_settings(config: Config) -> dict[str, Any]:
    """The settings that may change while running, with their values."""
    return {name: getattr(config, name) for name, declared in settings_of(Config).items() if declared.live}

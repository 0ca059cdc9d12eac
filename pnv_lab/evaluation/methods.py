"""The methods of the paper's tables: what is extracted, what retrieves, what re-ranks.

A method is written NAME, NAME:DIM or NAME@WEIGHTS (NAME:DIM@WEIGHTS). DIM keeps the leading dimensions of the PCA.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from pnv_core.config import PRESETS, Config
from pnv_core.decide.order import standing
from pnv_core.errors import ConfigError
from pnv_core.types import Evidence
from pnv_core.verify.reranker import Reranker
from pnv_lab.evaluation.extraction import Record, descriptor_of
from pnv_lab.evaluation.local_features import LIGHTGLUE_KINDS, lightglue_scorer, sift_score
from pnv_lab.evaluation.multiscale import cross_size_score, early_fusion_score

PairScore = Callable[[Record, Record], float]
SINGLE_SIZE = 5  # the paper's, section 4.1
PUBLISHED_PRESETS = tuple(name for name in PRESETS if name != "default")


@dataclass(frozen=True)
class Method:
    """One row of a table. `features` are what is re-ranked with, `retrieval` what the candidates come from.

    sizes: "single" (the paper's 5, or the middle one of the model's), "multi" (the model's), or explicit ones.
    fusion: "model" (its weights where it names these sizes, else equal), "equal", or explicit weights.
    scorer: "" (retrieval only), ransac, rapid, early, cross, sift, a LightGlue kind, or configured: as the recogniser
    orders candidates under the settings given, before local features.
    preset: of the recogniser, in place of the settings given.
    """

    name: str
    label: str
    retrieval: str = "patchnetvlad"
    features: str = "patchnetvlad"
    scorer: str = ""
    sizes: str | tuple[int, ...] = "multi"
    fusion: str | tuple[float, ...] = "model"
    dim: int | None = None
    weights: str | None = None
    preset: str = ""

    def config(self, base: Config) -> Config:
        """The Config its features are extracted with."""
        if self.preset:
            base = base.replace(preset=self.preset, **PRESETS[self.preset])
        return base if self.weights is None else base.replace(weights=self.weights)

    def wanted_sizes(self, completed: Config) -> tuple[int, ...]:
        """The patch sizes it scores, given the describer's completed Config."""
        if isinstance(self.sizes, tuple):
            return self.sizes
        if self.sizes == "multi":
            return completed.patch_sizes
        own = completed.patch_sizes
        return (SINGLE_SIZE,) if SINGLE_SIZE in own else (sorted(own)[len(own) // 2],)

    def pair_score(self, completed: Config) -> PairScore | None:
        """The score of two records, or None for a method that only retrieves."""
        if not self.scorer:
            return None
        if self.scorer == "sift":
            return sift_score
        if self.scorer in LIGHTGLUE_KINDS:
            return lightglue_scorer(self.scorer, completed.device)
        sizes = self.wanted_sizes(completed)
        if self.scorer in ("early", "cross"):
            score = early_fusion_score if self.scorer == "early" else cross_size_score
            return lambda q, r: score(descriptor_of(q, sizes, self.dim), descriptor_of(r, sizes, self.dim))
        reranker = self.reranker(completed)
        by_all = self.scorer == "configured" and completed.preset == "default"

        def ranked_by(q: Record, r: Record) -> float:
            query, reference = descriptor_of(q, sizes, self.dim), descriptor_of(r, sizes, self.dim)
            result = reranker.score(query, reference)
            if not by_all:
                return result.score
            return standing(
                Evidence(float(query.global_vector @ reference.global_vector), result.score, result.inliers)
            )

        return ranked_by

    def reranker(self, completed: Config) -> Reranker:
        """The product's own scorer under this method's sizes and weights."""
        sizes = self.wanted_sizes(completed)
        if isinstance(self.fusion, tuple):
            fusion = self.fusion
        elif self.fusion == "model" and sizes == completed.patch_sizes:
            fusion = completed.patch_weights
        else:
            fusion = (1.0 / len(sizes),) * len(sizes)
        scorer = completed.scorer if self.scorer == "configured" else self.scorer
        if self.scorer in ("early", "cross"):
            scorer = "ransac"
        strides = dict(zip(completed.patch_sizes, completed.patch_strides, strict=True))
        return Reranker(
            completed.replace(
                patch_sizes=sizes,
                patch_strides=tuple(strides.get(s, 1) for s in sizes),
                patch_weights=fusion,
                scorer=scorer,
            )
        )


def global_method() -> Method:
    """Retrieval by the global vector alone."""
    return Method("netvlad", "NetVLAD")


def configured_method() -> Method:
    """The recogniser's order under the user's settings."""
    return Method("patchnetvlad", "Patch-NetVLAD (as configured)", scorer="configured")


METHODS: dict[str, Method] = {
    m.name: m
    for m in (
        global_method(),
        configured_method(),
        Method("single-rapid", "Single-Spatial-Patch-NetVLAD", scorer="rapid", sizes="single"),
        Method("single-ransac", "Single-RANSAC-Patch-NetVLAD", scorer="ransac", sizes="single"),
        Method("multi-rapid", "Multi-Spatial-Patch-NetVLAD", scorer="rapid"),
        Method("multi-ransac", "Multi-RANSAC-Patch-NetVLAD", scorer="ransac"),
        Method("densevlad", "DenseVLAD", retrieval="densevlad", features="densevlad"),
        Method("gem", "GeM pooling", retrieval="gem", features="gem"),
        Method("patch-average", "Patch average pooling", features="average", scorer="ransac"),
        Method("patch-max", "Patch max pooling", features="maximum", scorer="ransac"),
        Method("early-fusion", "Early match fusion", scorer="early"),
        Method("cross-size", "Matching across patch sizes", scorer="cross"),
        Method("equal-weights", "Equal fusion weights", scorer="ransac", fusion="equal"),
        Method("sift", "SIFT, ratio test, RANSAC", features="sift", scorer="sift"),
        *(Method(kind, label, features=kind, scorer=kind) for kind, label in LIGHTGLUE_KINDS.items()),
        *(Method(name, f"Preset {name}", scorer="configured", preset=name) for name in PUBLISHED_PRESETS),
    )
}
GROUPS = {
    "paper": ("densevlad", "gem", "netvlad", "sift", "multi-ransac"),
    "variants": ("netvlad", "single-rapid", "single-ransac", "multi-rapid", "multi-ransac"),
    "ablations": ("multi-ransac", "equal-weights", "early-fusion", "cross-size", "patch-average", "patch-max"),
    "presets": ("patchnetvlad", *PUBLISHED_PRESETS, "lightglue"),
    "all": tuple(name for name in METHODS if name not in (*LIGHTGLUE_KINDS, *PUBLISHED_PRESETS, "patchnetvlad")),
}


def parse_methods(text: str) -> list[Method]:
    """NAME[:DIM][@WEIGHTS], separated by commas; a group stands for its methods. Raises ConfigError."""
    found: dict[str, Method] = {}
    for item in (part.strip() for part in text.split(",")):
        if not item:
            continue
        for name in GROUPS.get(item, (item,)):
            method = parse_method(name)
            found[method.name] = method
    if not found:
        raise ConfigError(f"--method {text!r} names no method; allowed: {_allowed()}")
    return list(found.values())


def parse_method(text: str) -> Method:
    """One method; [sizes=2+5+8;weights=0.4+0.2+0.4] after a patch method changes its sizes and fusion weights."""
    match = re.fullmatch(r"([\w-]+)(?:\[([^\]]*)\])?(?::(\d+))?(?:@(.+))?", text)
    if match is None or match[1] not in METHODS:
        raise ConfigError(f"--method {text!r} is not one of {_allowed()}")
    method = METHODS[match[1]]
    if match[2] is not None:
        method = _with_options(method, match[2], text)
    if match[3] is not None:
        if int(match[3]) < 1:
            raise ConfigError(f"--method {text!r}: dimension 0; allowed: 1 or more")
        method = replace(method, dim=int(match[3]), label=f"{method.label}, PCA {match[3]}")
    if match[4] is not None:
        shown = match[4] if match[4] in PRESETS else Path(match[4]).name.removesuffix(".safetensors")
        method = replace(method, weights=match[4], label=f"{method.label} ({shown})")
    return replace(method, name=text)


def _with_options(method: Method, text: str, whole: str) -> Method:
    options = dict(part.split("=", 1) for part in text.split(";") if "=" in part)
    if method.scorer not in ("ransac", "rapid", "early", "cross") or not options or set(options) - {"sizes", "weights"}:
        raise ConfigError(f"--method {whole!r}: allowed after a patch method: [sizes=2+5+8;weights=0.4+0.2+0.4]")
    try:
        sizes = tuple(int(s) for s in options["sizes"].split("+")) if "sizes" in options else method.sizes
        fusion = tuple(float(w) for w in options["weights"].split("+")) if "weights" in options else method.fusion
    except ValueError:
        raise ConfigError(f"--method {whole!r}: sizes are whole numbers and weights are numbers, joined by +") from None
    if isinstance(fusion, tuple):
        if abs(sum(fusion) - 1) > 0.02 or (isinstance(sizes, tuple) and len(sizes) != len(fusion)):
            raise ConfigError(f"--method {whole!r}: allowed: as many weights as sizes, with a sum of 1")
        fusion = tuple(w / sum(fusion) for w in fusion)
    return replace(method, sizes=sizes, fusion=fusion, label=f"{method.label} [{text}]")


def _allowed() -> str:
    return ", ".join([*METHODS, *(f"{name} (a group)" for name in GROUPS)])

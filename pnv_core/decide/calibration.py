"""From what is known of a candidate to P(same place).

A logistic model over a few features, each with a weight of at least zero: more similarity, more inliers or a wider
spread never lower the score. It was fitted on pairs of known truth, so its output can be read as a probability, as
`reliability` shows.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open

from pnv_core.config import Config
from pnv_core.describe.model_files import load_model, save_model
from pnv_core.errors import ModelError
from pnv_core.types import Evidence

Array = NDArray[np.float64]

CHANCE = 8  # as many local features agree on some epipolar geometry by chance
_LARGEST_DISTORTION = 2.0  # beyond it a map is as implausible as it gets
_FEW_MATCHES = 40  # of fewer the share means little
_FEW_INLIERS = 4
_SURE_LEAD = 0.15  # of similarity


def support(evidence: Evidence) -> float:
    """The share of the mutual local matches that agree, times the square of the spatial score, as a logarithm.

    What serves a model without a calibration of its own: how similar its other places are says nothing yet.
    """
    agreeing = max(evidence.local_inliers - CHANCE / 2, 1.0) / max(evidence.local_matches, _FEW_MATCHES)
    return math.log(agreeing) + 2.0 * math.log(max(evidence.spatial, 0.01) / 0.01)


def accord(evidence: Evidence) -> float:
    """Log odds, but for a slope and a bias, that local features, patches and the rest of the map give a candidate.

    Inliers alone do not part look-alike corridors from a place by night. How near the matches are, measured by how near
    features of one image are to each other, does, and how alike the map's other places look; what stands out from the
    best of them is a place seen from elsewhere rather than one of many corridors, but up to a bound: of two doors in a
    map of a few one stands out as well. Free weights, fitted on some sets and judged on others, let corridors pass;
    these are round numbers that serve on the places choices are made on.
    """
    inliers, spatial = max(evidence.local_inliers, _FEW_INLIERS), max(evidence.spatial, 0.01)
    return math.log(inliers) + 0.5 * math.log(spatial) + _beside(evidence, 6.0)


def concord(evidence: Evidence) -> float:
    """As accord, where the closer look was taken: with the sum of its probabilities in the place of the inliers.

    It finds one place from far along the way as well, where the points of one image lie nearer together: a closure at
    that distance is of little use, and two places have a view of one landmark.
    """
    sure, spatial = max(evidence.match_confidence, 0.0), max(evidence.spatial, 0.01)
    far = math.log(max(evidence.magnification, 1.0))
    return math.log(sure + 1.0) - far + 0.5 * math.log(spatial) + _beside(evidence, 8.0)


def _beside(evidence: Evidence, lead: float) -> float:
    """What the image and the rest of the map say: how alike features look, and how alike other places."""
    likeness = min(evidence.likeness, 0.0)  # the tiles of a wall are nearer to each other than to their own image
    return 2.0 * likeness + lead * max(0.0, min(evidence.lead, _SURE_LEAD)) - 5.0 * evidence.background


# Every feature grows with the belief in the candidate.
_FEATURES: dict[str, dict[str, Callable[[Evidence], float]]] = {
    "patches": {
        "spatial": lambda e: math.log(max(e.spatial, 1e-3)),
        "regularity": lambda e: -min(e.distortion, _LARGEST_DISTORTION),
        "spread": lambda e: e.spread,
        "similarity": lambda e: e.similarity,
        "lead": lambda e: max(e.lead, 0.0),
        "recent_lead": lambda e: e.recent_lead,
        "spatial_lead": lambda e: max(e.spatial_lead, 0.0),
    },
    "verified": {"accord": accord},
    "matched": {"concord": concord},
}
_VALUES = _FEATURES["patches"] | _FEATURES["verified"] | _FEATURES["matched"] | {"support": support}
_FORMER = {"local_inliers", "local_spread", "local_share", "agreement"}  # what files of earlier releases may name


# bounds of what a file may say
_Number = Annotated[float, msgspec.Meta(ge=0.0, le=1e6)]
_Whole = Annotated[int, msgspec.Meta(ge=0, le=10_000)]
_Text = Annotated[str, msgspec.Meta(max_length=10_000)]


@dataclass(frozen=True)
class Logistic:
    """P = 1 / (1 + exp(-(bias + sum of weight * feature))), weights by feature name, none negative."""

    bias: Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
    weights: dict[str, _Number]

    def probability(self, evidence: Evidence) -> float:
        logit = self.bias + sum(weight * _VALUES[name](evidence) for name, weight in self.weights.items())
        return 1.0 / (1.0 + math.exp(-max(-30.0, min(30.0, logit))))


@dataclass(frozen=True)
class _Written:
    """A calibration as a model file holds it."""

    patches: Logistic
    verified: Logistic
    scorer: _Text
    patch_sizes: tuple[_Whole, ...]
    image_size: tuple[_Whole, _Whole]
    source: _Text
    patch_strides: tuple[_Whole, ...] = ()
    patch_weights: tuple[_Number, ...] = ()
    scale_weight: _Number = 0.3
    verifier: _Text = "rootsift"
    matched: Logistic | None = None


@dataclass(frozen=True)
class Calibration:
    """P(same place) of candidates that only their patches speak for, of those that local features verified, and of
    those that were looked at closer, which none is where there is no `matched`.

    It holds for the settings it was fitted with that shape the evidence. What a file does not name is as it was for all
    models before it was recorded: strides of 1, RootSIFT, any fusion weights, and spatial scores that fell by up to
    `scale_weight` where the scale differed, which none does now.
    """

    patches: Logistic
    verified: Logistic
    scorer: str = "ransac"
    patch_sizes: tuple[int, ...] = ()
    image_size: tuple[int, int] = (0, 0)
    source: str = ""  # what it was fitted on
    patch_strides: tuple[int, ...] = ()
    patch_weights: tuple[float, ...] = ()
    scale_weight: float = 0.0
    verifier: str = "rootsift"
    matched: Logistic | None = None

    def probability(self, evidence: Evidence) -> float:
        if self.matched is not None and evidence.match_confidence >= 0:
            return self.matched.probability(evidence)
        model = self.patches if evidence.local_inliers < 0 else self.verified
        return model.probability(evidence)

    def suits(self, config: Config) -> bool:
        """Whether it was fitted with the settings of a completed Config that shape the evidence."""
        return not self.differences(config)

    def differences(self, config: Config) -> dict[str, Any]:
        """The settings by name that it was fitted with and that a completed Config has otherwise."""
        own = _evidence_settings(config)
        strides = self.patch_strides or (1,) * len(self.patch_sizes)
        fitted = replace(self, patch_strides=strides, patch_weights=self.patch_weights or own["patch_weights"])
        found = {name: getattr(fitted, name) for name, value in own.items() if getattr(fitted, name) != value}
        parts = (self.patches, self.verified, *([self.matched] if self.matched else []))
        former = sorted({name for part in parts for name in part.weights} - set(_VALUES))
        return found | ({"features": " and ".join(former) + " of an earlier release (pnv calibrate)"} if former else {})

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, given: dict[str, Any]) -> "Calibration":
        """Raises ModelError for anything but what `to_json` writes."""
        try:
            written = msgspec.convert(given, _Written)
        except (msgspec.ValidationError, RecursionError) as error:
            raise ModelError(f"calibration is incomplete or malformed ({error}); refit: pnv calibrate") from None
        for name, features in _FEATURES.items():
            model: Logistic | None = getattr(written, name)
            if model is None:
                continue
            unknown = set(model.weights) - set(_VALUES) - _FORMER
            if unknown or not np.isfinite([model.bias, *model.weights.values()]).all():
                allowed = ", ".join(features)
                raise ModelError(f"calibration.{name} = {given[name]}; allowed: weights >= 0 of {allowed}")
        return cls(**vars(written))


# For models without a calibration of their own. The patch part never passes 0.5: patch scores of an unknown model have
# an unknown scale. Local features are the same whatever the model: at a spatial score of 0.2 a sixth of the mutual
# matches that agree is worth 0.5.
CONSERVATIVE = Calibration(
    Logistic(-4.0, {"spatial": 1.0, "regularity": 1.0}),
    Logistic(-9.2, {"support": 2.2}),
    source="no calibration of this model",
)


def calibration_for(stored: dict[str, Any] | None, config: Config) -> Calibration:
    """The calibration in a model file's metadata, or the conservative one where none suits the Config."""
    if stored is None:
        return CONSERVATIVE
    calibration = Calibration.from_json(stored)
    return calibration if calibration.suits(config) else CONSERVATIVE


def why_conservative(stored: dict[str, Any] | None, config: Config) -> str:
    """Why the conservative calibration decides, in words; empty where the model's own does."""
    if stored is None:
        return "the model has no calibration (pnv calibrate makes one): a conservative score decides"
    other = Calibration.from_json(stored).differences(config)
    fitted = ", ".join(f"{name} = {value}" for name, value in other.items())
    return f"the model's calibration is for {fitted}: a conservative score decides" if other else ""


def write_calibration(path: Path | str, calibration: Calibration) -> None:
    """Put the calibration into a model file, whole or not at all; the tensors and the fingerprint stay as they are."""
    with safe_open(str(path), framework="np") as file:
        kept = {file.get_tensor(name).dtype for name in file.keys()}  # noqa: SIM118 - no mapping
    model = load_model(path).with_info(calibration=calibration.to_json())
    save_model(model, path, dtype=kept.pop() if len(kept) == 1 else np.float32)


def fit_calibration(
    examples: Sequence[tuple[Evidence, bool]], weights: Array, config: Config, source: str
) -> Calibration:
    """The models from evidence of known truth; examples not examined by local features serve the patch model alone, and
    those that were looked at closer the third, which is left out where they are of one class.

    `weights` (N,) says how much each example counts. Raises ModelError if either class is missing.
    """
    truth = np.array([label for _, label in examples], bool)
    if truth.all() or not truth.any():
        raise ModelError(f"{len(truth)} candidates, {truth.sum()} of them true; allowed: some true and some false ones")
    used = {
        "patches": np.ones_like(truth),
        "verified": np.array([e.local_inliers >= 0 for e, _ in examples]),
        "matched": np.array([e.match_confidence >= 0 for e, _ in examples]),
    }
    models: dict[str, Logistic | None] = {}
    for name, features in _FEATURES.items():
        use = used[name]
        if not truth[use].any() or truth[use].all():
            models[name] = getattr(CONSERVATIVE, name)
            continue
        table = np.array([[f(e) for f in features.values()] for (e, _), u in zip(examples, use, strict=True) if u])
        models[name] = _fit_logistic(table, truth[use], weights[use], list(features))
    return Calibration(**models, source=source, **_evidence_settings(config))  # type: ignore[arg-type]


_LIKE = {"usac": "ransac"}  # finds its inliers but for a few, so a calibration serves both


def _evidence_settings(config: Config) -> dict[str, Any]:
    names = ("scorer", "patch_sizes", "patch_strides", "patch_weights", "verifier")
    held = {name: getattr(config, name) for name in names} | {"image_size": (config.image_width, config.image_height)}
    return held | {"scorer": _LIKE.get(config.scorer, config.scorer), "scale_weight": 0.0}


def _fit_logistic(
    table: Array, truth: NDArray[np.bool_], weights: Array, names: list[str], ridge: float = 1e-3
) -> Logistic:
    """Weighted maximum likelihood with non-negative weights and a small ridge on the standardised features."""
    centre, scale = table.mean(0), table.std(0) + 1e-9
    x = np.column_stack([np.ones(len(table)), (table - centre) / scale])
    share = weights / weights.sum()
    sign = np.where(truth, 1.0, -1.0)

    def loss(theta: Array) -> tuple[float, Array]:
        margin = sign * (x @ theta)
        gradient = -(share * sign / (1.0 + np.exp(np.clip(margin, -500, 500)))) @ x
        penalty = np.concatenate([[0.0], ridge * theta[1:]])
        return float(share @ np.logaddexp(0.0, -margin) + 0.5 * penalty @ theta), gradient + penalty

    bounds = [(None, None)] + [(0.0, None)] * table.shape[1]
    from scipy.optimize import minimize  # half a second that recognition need not wait for at start

    theta = minimize(loss, np.zeros(x.shape[1]), jac=True, bounds=bounds, method="L-BFGS-B").x
    slopes = theta[1:] / scale
    return Logistic(
        float(theta[0] - slopes @ centre), {n: round(float(w), 6) for n, w in zip(names, slopes, strict=True)}
    )


@dataclass(frozen=True)
class Reliability:
    """Per occupied bin of the score: mean score, share of true ones, count."""

    score: Array
    share_true: Array
    count: NDArray[np.int64]

    @property
    def expected_error(self) -> float:
        """Expected calibration error: mean |score - share true|, weighted by count (Naeini et al., AAAI 2015)."""
        return float(np.abs(self.score - self.share_true) @ self.count / max(self.count.sum(), 1))


def reliability(scores: Array, truth: NDArray[np.bool_], bins: int = 10) -> Reliability:
    """The reliability diagram of scores (N,) in [0, 1] in bins of equal width."""
    place = np.minimum((np.asarray(scores) * bins).astype(int), bins - 1)
    count = np.bincount(place, minlength=bins)
    used = count > 0
    mean = [np.bincount(place, values, minlength=bins)[used] / count[used] for values in (scores, truth.astype(float))]
    return Reliability(mean[0], mean[1], count[used])


def threshold_for_precision(scores: Array, truth: NDArray[np.bool_], precision: float) -> float:
    """The least score from which on at least `precision` of all candidates are true; above 1 if there is none."""
    order = np.argsort(-np.asarray(scores), kind="stable")
    ranked, good = np.asarray(scores)[order], np.asarray(truth, bool)[order]
    reached = np.cumsum(good) / np.arange(1, len(good) + 1) >= precision
    last = np.append(ranked[1:] < ranked[:-1], True)  # a threshold cannot part equal scores
    usable = np.flatnonzero(reached & last)
    return float(ranked[usable[-1]]) if len(usable) else math.nextafter(1.0, 2.0)

"""Calibration on a user's own sequence: run the recogniser, tell true candidates from false ones, fit."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnv_core.decide.calibration import (
    Calibration,
    Reliability,
    calibration_for,
    fit_calibration,
    reliability,
    threshold_for_precision,
)
from pnv_core.describe.describer import Describer
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.types import Evidence, Frame
from pnv_lab.evaluation.datasets.tables import rows
from pnv_lab.poses import read_poses

# Is it the same place? None where that is not known. Arguments: name and stamp [ns] of query and match.
Truth = Callable[[str, int, str, int], bool | None]

# local inliers, three times what other places have by chance: an unlabelled loop rather than a look-alike
SURE_REVISIT = 36


@dataclass(frozen=True, eq=False)
class Examples:
    """Evidence of candidates (N) and whether each is true."""

    evidence: list[Evidence]
    true: NDArray[np.bool_]


def gather_examples(
    describer: Describer, frames: Iterable[tuple[str, Frame]], truth: Truth, recent_s: float
) -> Examples:
    """Every candidate of a sequence whose truth is known. `recent_s` is the exclusion window while gathering."""
    config = describer.config
    config = config.replace(exclude_recent_s=recent_s, consistency=0, verify=min(100, config.candidates))
    recognizer = PlaceRecognizer(Describer(describer.model, config))
    names: dict[tuple[str, int], str] = {}
    evidence, true = [], []
    for name, frame in frames:
        names[frame.camera, frame.stamp_ns] = name
        for closure in recognizer.process(frame):
            query, match = closure.query.stamp_ns, closure.match.stamp_ns
            label = truth(name, query, names[closure.match.camera, match], match)
            if label is not None and closure.evidence is not None:
                evidence.append(closure.evidence)
                true.append(label)
    return Examples(evidence, np.array(true, bool))


def calibrate(examples: Examples, describer: Describer, source: str) -> Calibration:
    """The calibration of the examples; true and false ones keep their numbers. Raises ModelError for one class only.

    A sequence has few candidates in doubt: what the closer look is worth stays as the model has it.
    """
    pairs = [
        (replace(e, match_confidence=-1.0), bool(true))
        for e, true in zip(examples.evidence, examples.true, strict=True)
    ]
    own = calibration_for(describer.model.info.calibration, describer.config)
    return replace(fit_calibration(pairs, np.ones(len(pairs)), describer.config, source), matched=own.matched)


@dataclass(frozen=True, eq=False)
class Checked:
    """How a calibration does on candidates it was not fitted to."""

    scores: NDArray[np.float64]
    true: NDArray[np.bool_]

    @property
    def diagram(self) -> Reliability:
        return reliability(self.scores, self.true)

    def threshold(self, precision: float) -> float:
        return threshold_for_precision(self.scores, self.true, precision)


def cross_check(examples: Examples, describer: Describer, parts: int = 4) -> Checked | None:
    """Every part of the sequence in time judged by a fit to the others; None where a part leaves one class only."""
    count = len(examples.true)
    part = np.arange(count) * parts // max(count, 1)
    scores = np.zeros(count)
    for p in range(parts):
        use = part != p
        rest = Examples([e for e, u in zip(examples.evidence, use, strict=True) if u], examples.true[use])
        if rest.true.all() or not rest.true.any():
            return None
        fitted = calibrate(rest, describer, "")
        for i in np.flatnonzero(~use):
            scores[i] = fitted.probability(examples.evidence[i])
    return Checked(scores, examples.true)


def truth_of_time(near_s: float, far_s: float) -> Truth:
    """Self-supervised: images at most `near_s` apart show one place, those `far_s` apart another."""

    def truth(query: str, query_ns: int, match: str, match_ns: int) -> bool | None:
        apart = abs(query_ns - match_ns) / 1e9
        return True if apart <= near_s else False if apart >= far_s else None

    return truth


def without_unlabelled_loops(examples: Examples) -> Examples:
    """Less the false ones that local features agree on: with truth from time alone they are revisits."""
    keep = np.array(
        [t or e.local_inliers < SURE_REVISIT for e, t in zip(examples.evidence, examples.true, strict=True)]
    )
    return Examples([e for e, k in zip(examples.evidence, keep, strict=True) if k], examples.true[keep])


def truth_of_poses(path: Path | str, radius_m: float, heading_deg: float) -> Truth:
    """From --poses: within the radius and heading is one place, beyond twice either another."""
    poses = read_poses(path)

    def truth(query: str, query_ns: int, match: str, match_ns: int) -> bool | None:
        a, b = poses.row(query, query_ns), poses.row(match, match_ns)
        if a is None or b is None:
            return None
        far = float(np.linalg.norm(poses.positions[a] - poses.positions[b])) / radius_m
        far = max(far, poses.turn_deg(a, b) / heading_deg)
        return True if far <= 1 else False if far >= 2 else None

    return truth


def truth_of_matches(path: Path | str) -> Truth:
    """From a CSV of query,true_refs (references separated by `;`): queries not listed are not judged."""
    true = {r["query"]: set((r["true_refs"] or "").split(";")) for r in rows(Path(path), ("query", "true_refs"))}

    def truth(query: str, query_ns: int, match: str, match_ns: int) -> bool | None:
        return match in true[query] if query in true else None

    return truth

"""Which candidate of a query comes first."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pnv_core.config import Config
from pnv_core.decide.order import Order, standing
from pnv_core.types import Evidence, ImageRef, LoopClosure


def closure(match: int, similarity: float, spatial: float, own: int = 0) -> LoopClosure:
    evidence = Evidence(similarity, spatial, 10, own_matches=own)
    here, there = ImageRef(99, 0, "front"), ImageRef(match, 0, "front")
    return LoopClosure(here, there, 0.5, similarity, spatial, 10, False, evidence=evidence)


def ranked(closures: list[LoopClosure], config: Config) -> list[int]:
    return [c.match.id for c in sorted(closures, key=Order(config))]


ALIKE = [
    closure(0, 0.60, 0.05),
    closure(1, 0.40, 0.09),
]  # another viewpoint of the place, and patches that look like it


def test_patches_alone_do_not_put_a_place_of_another_look_first_but_in_the_papers_order():
    assert ranked(ALIKE, Config.make()) == [0, 1]
    assert ranked(ALIKE, Config.make("speed")) == [1, 0]


def test_local_features_that_no_other_place_has_put_a_candidate_first():
    assert ranked([ALIKE[0], closure(1, 0.40, 0.09, own=60)], Config.make()) == [1, 0]


def test_an_accepted_closure_comes_before_a_refused_one():
    assert ranked([ALIKE[0], replace(ALIKE[1], accepted=True)], Config.make()) == [1, 0]


def test_of_equal_candidates_the_older_comes_first():
    assert ranked([closure(5, 0.5, 0.1), closure(2, 0.5, 0.1)], Config.make()) == [2, 5]


@pytest.mark.parametrize("name", ["similarity", "spatial", "own_matches"])
@given(st.floats(0, 1), st.floats(0, 1), st.integers(0, 200), st.floats(0, 1))
def test_more_of_any_evidence_never_moves_a_candidate_back(name, similarity, spatial, own, more):
    evidence = Evidence(similarity, spatial, 10, own_matches=own)
    step = round(100 * more) if name == "own_matches" else more
    raised = replace(evidence, **{name: getattr(evidence, name) + step})
    assert standing(raised) >= standing(evidence)

"""The score as a probability: fitting, judging by hand-computed figures, and living in a model file."""

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pnv_core.config import Config
from pnv_core.decide.calibration import (
    CONSERVATIVE,
    Calibration,
    Logistic,
    accord,
    calibration_for,
    concord,
    fit_calibration,
    reliability,
    threshold_for_precision,
    why_conservative,
    write_calibration,
)
from pnv_core.describe.model_files import load_model, save_model
from pnv_core.errors import ModelError
from pnv_core.types import Evidence
from test.core.small import small_model
from test.edited_json import edited
from test.tally import count, tally

CONFIG = Config.make(
    image_width=320, image_height=240, patch_sizes=(2, 3), patch_strides=(1, 1), patch_weights=(0.5, 0.5)
)


def drawn(rng, n, examined=True):
    """Evidence whose truth follows a logistic law in what local features, patches and other places say."""
    found = []
    for _ in range(n):
        inliers, spatial = int(rng.integers(8, 60)), float(rng.uniform(0.02, 0.4))
        matches, likeness, background = int(rng.integers(inliers, 250)), rng.uniform(-1.5, 0), rng.uniform(0.1, 0.6)
        agreeing, likely, rare = np.log(inliers * np.sqrt(spatial) / 9), 2 * (likeness + 0.7), 5 * (0.3 - background)
        lead = float(rng.uniform(-0.05, 0.15))
        logit = 1.2 * (agreeing + likely + rare + 6 * max(lead, 0))
        e = Evidence(
            0.4, spatial, 50, 0.5, 0.2, local_inliers=inliers if examined else -1, local_matches=matches,
            likeness=float(likeness), background=float(background), lead=lead,
        )  # fmt: skip
        found.append((e, bool(rng.random() < 1 / (1 + np.exp(-logit))), 1 / (1 + np.exp(-logit))))
    return found


def test_the_fit_finds_the_probability_the_examples_were_drawn_with():
    rng = np.random.default_rng(0)
    examples = drawn(rng, 6000)
    fitted = fit_calibration([(e, t) for e, t, _ in examples], np.ones(6000), CONFIG, "drawn")
    fresh = drawn(rng, 500)
    error = [abs(fitted.probability(e) - p) for e, _, p in fresh]
    assert np.mean(error) < 0.03
    assert fitted.suits(CONFIG)


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(
        [
            f.name
            for f in dataclasses.fields(Evidence)
            if f.name not in ("texture", "distortion", "inliers", "local_matches", "background")
        ]
    ),
    st.floats(0, 1),
    st.integers(0, 3),
)
def test_more_of_any_evidence_never_lowers_the_score(name, step, seed):
    rng = np.random.default_rng(seed)
    examples = [(e, t) for e, t, _ in drawn(rng, 200)]
    fitted = fit_calibration(examples, np.ones(200), CONFIG, "")
    e = examples[0][0]
    more = round(step * 40) if name == "local_inliers" else step
    raised = dataclasses.replace(e, **{name: getattr(e, name) + more})
    for calibration in (fitted, CONSERVATIVE):
        assert calibration.probability(raised) >= calibration.probability(e) - 1e-12
        for against in (
            {"distortion": e.distortion + step},
            {"local_matches": e.local_matches + round(step * 40)},
            {"background": e.background + step},
        ):
            assert calibration.probability(dataclasses.replace(e, **against)) <= calibration.probability(e) + 1e-12


def test_a_lead_counts_up_to_a_bound():
    seen = Evidence(similarity=0.9, spatial=0.5, inliers=40, local_inliers=60, local_matches=90)
    leads = [-0.2, 0.0, 0.1, 0.15, 0.6]
    added = [
        accord(dataclasses.replace(seen, lead=lead)) - accord(dataclasses.replace(seen, lead=0.0)) for lead in leads
    ]
    assert np.allclose(added, [0.0, 0.0, 0.6, 0.9, 0.9])


def looked_at(rng, n):
    """Evidence of a closer look, whose truth follows a logistic law in what it found."""
    found = []
    for e, _, _ in drawn(rng, n):
        sure, times = float(rng.uniform(0, 80)), float(rng.uniform(1, 3))
        e = dataclasses.replace(e, match_confidence=sure, magnification=times)
        says = np.log((sure + 1) / times * np.sqrt(e.spatial)) + 2 * e.likeness + 8 * max(e.lead, 0) - 5 * e.background
        probability = 1 / (1 + np.exp(-0.9 * says - 0.3))
        found.append((e, bool(rng.random() < probability), probability))
    return found


def test_what_was_looked_at_closer_has_a_probability_of_its_own():
    rng = np.random.default_rng(0)
    examples = [(e, t) for e, t, _ in drawn(rng, 3000) + looked_at(rng, 6000)]
    fitted = fit_calibration(examples, np.ones(9000), CONFIG, "drawn")
    fresh = looked_at(rng, 500)
    assert np.mean([abs(fitted.probability(e) - p) for e, _, p in fresh]) < 0.03
    assert fitted == Calibration.from_json(json.loads(json.dumps(fitted.to_json())))
    without = fit_calibration([(e, t) for e, t, _ in drawn(rng, 3000)], np.ones(3000), CONFIG, "drawn")
    assert without.matched is None
    for e, _, _ in fresh:  # what nothing was fitted for counts for nothing
        assert without.probability(e) == without.probability(dataclasses.replace(e, match_confidence=-1.0))


@pytest.mark.parametrize(
    ("name", "more", "rises"),
    [
        ("match_confidence", 9.0, True),
        ("spatial", 0.1, True),
        ("likeness", 0.2, True),
        ("lead", 0.05, True),
        ("magnification", 0.5, False),
        ("background", 0.1, False),
    ],
)
def test_a_closer_look_believes_in_more_and_surer_matches_of_one_size(name, more, rises):
    seen = Evidence(0.6, 0.2, 40, likeness=-0.9, background=0.3, match_confidence=20.0, magnification=1.2)
    change = concord(dataclasses.replace(seen, **{name: getattr(seen, name) + more})) - concord(seen)
    assert (change > 0.05) if rises else (change < -0.05)
    assert concord(dataclasses.replace(seen, local_inliers=300)) == concord(seen)


def test_an_unknown_model_believes_no_candidate_on_its_patches_alone():
    for spatial in (0.0, 0.1, 0.3, 0.6):
        assert CONSERVATIVE.probability(Evidence(0.9, spatial, 200, 1.0, 0.0)) < 0.5
    assert CONSERVATIVE.probability(Evidence(0.5, 0.1, 50, 0.5, 0.3, local_inliers=8)) < 0.05
    assert CONSERVATIVE.probability(Evidence(0.5, 0.15, 50, 0.5, 0.3, local_inliers=40)) > 0.9


def test_expected_calibration_error_by_hand():
    scores = np.array([0.05, 0.05, 0.92, 0.98, 0.98, 0.98])
    truth = np.array([0, 1, 1, 1, 1, 0], bool)
    diagram = reliability(scores, truth)
    assert list(diagram.count) == [2, 4]
    # bins: mean 0.05 against 1/2, mean 0.965 against 3/4
    assert diagram.expected_error == pytest.approx((2 * 0.45 + 4 * 0.215) / 6)


def test_a_score_of_one_lies_in_the_last_bin_and_no_candidate_has_no_error():
    assert list(reliability(np.array([1.0, 1.0]), np.array([True, True])).count) == [2]
    assert reliability(np.zeros(0), np.zeros(0, bool)).expected_error == 0.0


@given(
    st.lists(st.tuples(st.sampled_from([0.1, 0.3, 0.5, 0.7, 0.9]), st.booleans()), max_size=40), st.floats(0.05, 1.0)
)
def test_the_threshold_is_that_of_a_plain_search(pairs, precision):
    scores = np.array([s for s, _ in pairs])
    truth = np.array([t for _, t in pairs], bool)
    found = threshold_for_precision(scores, truth, precision)
    reaching = [s for s in set(scores) if truth[scores >= s].mean() >= precision]
    if reaching:
        assert found == min(reaching)
    else:
        assert found > 1.0


def test_a_fit_needs_true_and_false_examples():
    examples = [(e, True) for e, _, _ in drawn(np.random.default_rng(0), 10)]
    with pytest.raises(ModelError, match="some true and some false"):
        fit_calibration(examples, np.ones(10), CONFIG, "")


def test_the_calibration_lives_in_the_model_file_and_leaves_the_model_as_it_is(tmp_path):
    path = tmp_path / "model.safetensors"
    save_model(small_model(), path)
    before = load_model(path)
    calibration = Calibration(
        Logistic(-1.0, {"spatial": 2.0}), Logistic(-2.0, {"accord": 3.0}), "ransac", (2, 3), (320, 240), "a test",
        verifier="xfeat",
    )  # fmt: skip
    write_calibration(path, calibration)
    after = load_model(path)
    assert after.fingerprint() == before.fingerprint()
    assert Calibration.from_json(after.info.calibration) == calibration
    assert calibration_for(after.info.calibration, CONFIG) == calibration
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_calibration_for_other_patches_or_another_scorer_is_not_used():
    fitted = Calibration(Logistic(0.0, {}), Logistic(0.0, {}), "ransac", (2, 3), (320, 240), "", verifier="xfeat")
    stored = fitted.to_json()
    assert calibration_for(stored, CONFIG) is not CONSERVATIVE
    assert calibration_for(stored, CONFIG.replace(scorer="rapid")) is CONSERVATIVE
    assert calibration_for(stored, CONFIG.replace(image_width=640)) is CONSERVATIVE
    assert calibration_for(None, CONFIG) is CONSERVATIVE
    scaled = stored | {"scale_weight": 0.3}  # scores that fell with the change of scale are no longer
    assert calibration_for(scaled, CONFIG) is CONSERVATIVE
    older = {name: value for name, value in stored.items() if name != "verifier"}  # when there was RootSIFT alone
    older["verified"] = {"bias": -4.0, "weights": {"spatial": 1.0, "local_inliers": 3.0}}
    assert calibration_for(older, CONFIG) is CONSERVATIVE
    former = stored | {"verified": {"bias": -4.0, "weights": {"agreement": 1.0}}}
    assert calibration_for(former, CONFIG) is CONSERVATIVE
    assert why_conservative(former, CONFIG) == (
        "the model's calibration is for features = agreement of an earlier release (pnv calibrate): "
        "a conservative score decides"
    )


def test_a_calibration_holds_for_the_settings_that_shape_the_evidence_it_was_fitted_on():
    examples = [(e, label) for e, label, _ in drawn(np.random.default_rng(0), 200)]
    stored = fit_calibration(examples, np.ones(200), CONFIG, "").to_json()
    assert calibration_for(json.loads(json.dumps(stored)), CONFIG) is not CONSERVATIVE
    for change in (
        {"patch_strides": (1, 2)},
        {"patch_weights": (0.9, 0.1)},
        {"verifier": "another"},
    ):
        assert calibration_for(stored, CONFIG.replace(**change)) is CONSERVATIVE, change
    for change in ({"accept_score": 0.9}, {"threads": 1}, {"patch_precision": "int8"}, {"verify": 1}):
        assert calibration_for(stored, CONFIG.replace(**change)) is not CONSERVATIVE, change


@pytest.mark.parametrize(
    "change",
    [
        {"patches": {"bias": 0.0, "weights": {"spatial": -1.0}}},
        {"patches": {"bias": 0.0, "weights": {"colour": 1.0}}},
        {"patches": {"bias": float("nan"), "weights": {}}},
        {"verified": None},
        {"image_size": [320]},
    ],
)
def test_a_malformed_calibration_is_refused(change):
    good = Calibration(Logistic(0.0, {}), Logistic(0.0, {}), "ransac", (2,), (320, 240), "").to_json()
    with pytest.raises(ModelError, match="calibration"):
        Calibration.from_json(good | change)


def test_a_calibration_of_any_content_is_refused_in_one_line_or_gives_probabilities_and_what_it_is_for_is_said():
    right = Calibration(
        Logistic(-1.0, {"spatial": 2.0}), Logistic(-2.0, {"accord": 3.0}), "ransac", (2, 3), (320, 240), "a test",
        verifier="xfeat", matched=Logistic(-1.0, {"concord": 2.0}),
    )  # fmt: skip
    rng = np.random.default_rng(0)
    evidence = [e for e, _, _ in drawn(rng, 20) + looked_at(rng, 20)]
    outcome = {"refused": 0, "said": 0, "same": 0}

    @settings(max_examples=count(200, 20_000), deadline=None, database=None)
    @given(edited(json.loads(json.dumps(right.to_json()))))
    def read(stored):
        try:
            calibration = calibration_for(stored, CONFIG)
        except ModelError as error:
            assert "\n" not in str(error)
            assert len(str(error)) <= 1000
            outcome["refused"] += 1
            return
        assert all(0 <= calibration.probability(e) <= 1 for e in evidence)
        assert (calibration is CONSERVATIVE) == bool(why_conservative(stored, CONFIG))
        outcome["said" if calibration is CONSERVATIVE else "same"] += 1

    read()
    former = right.to_json() | {"matched": {"bias": 0.0, "weights": {"agreement": 1.0}}}
    assert calibration_for(former, CONFIG) is CONSERVATIVE
    assert "agreement of an earlier release" in why_conservative(former, CONFIG)
    tried = sum(outcome.values())
    tally("8 calibrations with other content", tried, tried)
    assert min(outcome.values()) > 0
    assert why_conservative(None, CONFIG).startswith("the model has no calibration")
    other = why_conservative(right.to_json(), CONFIG.replace(scorer="rapid"))
    assert other == "the model's calibration is for scorer = ransac: a conservative score decides"

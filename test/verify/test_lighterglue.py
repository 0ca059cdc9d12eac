"""LighterGlue on the inference backend against its layers in torch, written anew from LightGlue's paper, and against
the package where that is installed; and what it finds on photographs."""

import cv2
import numpy as np
import pytest
import torch
from safetensors.numpy import load_file
from torch.nn import functional as F

from pnv_core.errors import ConfigError
from pnv_core.images import read_image
from pnv_core.verify.lighterglue import LAYERS, WEIGHTS, LighterGlue
from pnv_core.verify.local_features import MOST, LocalFeatures, XFeatVerifier, epipolar_check
from pnv_core.verify.verifier import CloserLook
from pnv_lab.evaluation.local_features import lighterglue

PIXELS = 640


class Published:
    """The layers as LightGlue's equations 2 to 8 have them, in float32, one image after the other, without padding."""

    def __init__(self):
        self.w = {name: torch.from_numpy(v.astype(np.float32)) for name, v in load_file(str(WEIGHTS)).items()}

    def linear(self, name, x):
        return F.linear(x, self.w[f"{name}.weight"], self.w[f"{name}.bias"])

    def taken_in(self, name, x, message):
        both = self.linear(f"{name}.ffn.0", torch.cat([x, message], -1))
        normal = F.layer_norm(both, both.shape[-1:], self.w[f"{name}.ffn.1.weight"], self.w[f"{name}.ffn.1.bias"])
        return x + self.linear(f"{name}.ffn.3", F.gelu(normal))

    def rotated(self, x, points):
        """Channel pair k turned by the angle w_k . p: complex numbers multiplied by exp(i angle)."""
        angle = points @ self.w["posenc.Wr.weight"].T
        pairs = torch.view_as_complex(x.reshape(len(x), -1, 2).contiguous())
        return torch.view_as_real(pairs * torch.polar(torch.ones_like(angle), angle)).reshape(x.shape)

    def heard(self, query, key, value):
        return F.scaled_dot_product_attention(query[None, None], key[None, None], value[None, None])[0, 0]

    def own(self, name, x, points):
        query, key, value = self.linear(f"{name}.Wqkv", x).reshape(len(x), -1, 3).unbind(-1)
        message = self.heard(self.rotated(query, points), self.rotated(key, points), value)
        return self.taken_in(name, x, self.linear(f"{name}.out_proj", message))

    def probability(self, images):
        points = [torch.from_numpy((f.points - (0.5, a / 2)).astype(np.float32)) * 2 / max(1.0, a) for f, a in images]
        a, b = (self.linear("input_proj", torch.from_numpy(f.descriptors)) for f, _ in images)
        for layer in range(LAYERS):
            name = f"transformers.{layer}"
            a, b = (self.own(f"{name}.self_attn", x, p) for x, p in zip((a, b), points, strict=True))
            name = f"{name}.cross_attn"
            keys, values = ([self.linear(f"{name}.{part}", x) for x in (a, b)] for part in ("to_qk", "to_v"))
            messages = self.heard(keys[0], keys[1], values[1]), self.heard(keys[1], keys[0], values[0])
            a, b = (
                self.taken_in(name, x, self.linear(f"{name}.to_out", m)) for x, m in zip((a, b), messages, strict=True)
            )
        name = f"log_assignment.{LAYERS - 1}"
        ours, theirs = (self.linear(f"{name}.final_proj", x) for x in (a, b))
        similarity = ours @ theirs.T / ours.shape[1] ** 0.5
        partner, other = (self.linear(f"{name}.matchability", x).sigmoid() for x in (a, b))
        return (similarity.softmax(0) * similarity.softmax(1) * partner * other.T).numpy()


def mutual(probability):
    """Pairs of mutual maxima over a tenth, one by one."""
    pairs = {}
    for i, row in enumerate(probability):
        j = int(row.argmax())
        if row[j] > 0.1 and int(probability[:, j].argmax()) == i:
            pairs[i, j] = float(row[j])
    return pairs


@pytest.fixture(scope="module")
def verifier():
    return XFeatVerifier()


@pytest.fixture(scope="module")
def pairs(shared, verifier):
    """Features of photographs beside those of the same ones seen from the side, and of others."""
    files = sorted((shared / "data/tiny").glob("*/*.jpg"))[::6]
    images = [cv2.resize(read_image(f), (PIXELS, 480)) for f in files]
    turned = [cv2.warpPerspective(image, sideways(), (PIXELS, 480)) for image in images]
    ours, theirs = ([(verifier.found(image), 0.75) for image in some] for some in (images, turned))
    return list(zip(ours, theirs, strict=True)), list(zip(ours, theirs[1:], strict=False))


def sideways():
    """A plane turned by some 50 degrees."""
    corners = np.float32([[0, 0], [PIXELS, 0], [PIXELS, 480], [0, 480]])
    return cv2.getPerspectiveTransform(corners, np.float32([[180, 0], [460, 130], [460, 350], [180, 480]]))


def random_features(seed, count):
    rng = np.random.default_rng(seed)
    descriptors = rng.normal(size=(count, 64)).astype(np.float32)
    points = rng.uniform(0, (1, 0.75), (count, 2)).astype(np.float32)
    return LocalFeatures(points, descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True))


@pytest.mark.parametrize(("count", "other"), [(MOST, MOST), (MOST, 37), (1, MOST), (120, 240), (MOST + 100, 9)])
def test_probabilities_are_those_of_the_paper_whatever_the_number_of_features(count, other):
    """Half of the features are the same in both, moved; the padding of the others must not be heard."""
    one, two = random_features(1, count), random_features(2, other)
    same = min(count, other) // 2
    two.descriptors[:same], two.points[:same] = one.descriptors[:same], one.points[:same] + 0.05
    seen = [LocalFeatures(f.points[:MOST], f.descriptors[:MOST]) for f in (one, two)]  # of more, the first
    expected = mutual(Published().probability(list(zip(seen, (0.75, 1.3), strict=True))))
    q, r, probability = LighterGlue(1).matches(one, 0.75, two, 1.3)
    clear = {pair: p for pair, p in expected.items() if p > 0.11}
    found = dict(zip(zip(q.tolist(), r.tolist(), strict=True), probability.tolist(), strict=True))
    assert set(clear) <= set(found)
    assert all(found[pair] == pytest.approx(p, abs=2e-3) for pair, p in clear.items())
    assert len(found) <= len(expected) + 2
    assert same < 200 or len(clear) > same / 3  # of few, one half by chance, it is not sure


def test_photographs_match_as_in_the_paper_and_almost_so_in_bfloat16(pairs, verifier):
    exact, short = LighterGlue(1), LighterGlue(1, "bfloat16")
    for one, other in pairs[0]:
        expected = mutual(Published().probability([one, other]))
        q, r, probability = exact.matches(*one, *other)
        assert probability.sum() == pytest.approx(sum(expected.values()), rel=0.01)
        assert len(set(zip(q, r, strict=True)) & set(expected)) > 0.97 * len(expected)
        assert short.matches(*one, *other)[2].sum() == pytest.approx(probability.sum(), rel=0.15, abs=3)


def test_photographs_match_as_with_the_authors_package(pairs):
    try:
        theirs = lighterglue()
    except ConfigError as error:
        pytest.skip(str(error))
    for one, other in pairs[0]:
        q, r, _ = LighterGlue(1).matches(*one, *other)
        expected = set(zip(*(numbers.tolist() for numbers in theirs(one, other)), strict=True))
        assert len(set(zip(q.tolist(), r.tolist(), strict=True)) & expected) > 0.97 * len(expected)


def test_a_plane_seen_from_the_side_is_matched_where_descriptors_by_themselves_fail(pairs):
    """Right are matches within 6 pixels of where the turned plane has the point."""
    glue, right, wrong, plain, elsewhere = LighterGlue(1), 0, 0, 0, 0
    for (one, aspect), (other, _) in pairs[0]:
        q, r, _ = glue.matches(one, aspect, other, aspect)
        expected = cv2.perspectiveTransform(one.points[None] * PIXELS, sideways())[0]
        near = np.linalg.norm(expected[q] - other.points[r] * PIXELS, axis=1) < 6
        right, wrong = right + near.sum(), wrong + (~near).sum()
        plain += epipolar_check(one, other, aspect).inliers
    for one, other in pairs[1]:
        elsewhere += glue.matches(*one, *other)[2].sum() / len(pairs[1])
    assert right > 4 * wrong
    assert right > 1.5 * plain
    assert right / len(pairs[0]) > 4 * elsewhere


def test_without_features_nothing_matches():
    none, some = random_features(0, 0), random_features(1, 9)
    for one, other in ((none, some), (some, none), (none, none)):
        q, r, probability = LighterGlue(1).matches(one, 1.0, other, 1.0)
        assert len(q) == len(r) == len(probability) == 0


@pytest.mark.parametrize("factor", [0.5, 0.8, 1.0, 1.7])
def test_magnification_is_that_of_an_image_made_smaller(shared, verifier, factor):
    image = cv2.resize(read_image(sorted((shared / "data/tiny").glob("*/*.jpg"))[0]), (PIXELS, 480))
    middle = np.float32([[factor, 0, 320 * (1 - factor)], [0, factor, 240 * (1 - factor)]])
    kept = [verifier.keep(i, "") for i in (image, cv2.warpAffine(image, middle, (PIXELS, 480)))]
    look = verifier.look_closer(*kept)
    assert look.confidence > 20
    assert look.magnification == pytest.approx(max(factor, 1 / factor), rel=0.12)
    assert verifier.look_closer(*kept[::-1]).magnification == pytest.approx(look.magnification, rel=0.1)


@pytest.mark.parametrize("spoilt", [b"", b"no such", b"PNVX\xff\xff" + bytes(4000)])
def test_what_is_damaged_or_empty_is_matched_with_nothing(shared, verifier, spoilt):
    kept = verifier.keep(read_image(sorted((shared / "data/tiny").glob("*/*.jpg"))[0]), "")
    assert verifier.look_closer(kept, kept).confidence > 100
    for pair in ((kept, spoilt), (spoilt, kept), (spoilt, spoilt)):
        assert verifier.look_closer(*pair) == CloserLook(0.0, 1.0)

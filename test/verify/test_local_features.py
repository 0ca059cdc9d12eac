"""Local features on drawn pictures: views of one scene agree, of others do not."""

import cv2
import numpy as np
import pytest

from pnv_core.verify.local_features import LocalFeatures, XFeatVerifier, epipolar_check, match, thumbnail

VERIFIER = XFeatVerifier()


def scene(seed, size=(480, 640)):
    """A picture full of random shapes."""
    rng = np.random.default_rng(seed)
    image = np.full((*size, 3), 128, np.uint8)
    for _ in range(150):
        centre = tuple(int(v) for v in rng.integers(0, (size[1], size[0])))
        colour = tuple(int(v) for v in rng.integers(0, 256, 3))
        axes = tuple(int(v) for v in rng.integers(5, 40, 2))
        cv2.ellipse(image, centre, axes, float(rng.uniform(0, 180)), 0, 360, colour, -1)
    return image


def view(image, shift, scale):
    matrix = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]], np.float32)
    return cv2.warpAffine(image, matrix, image.shape[1::-1], borderMode=cv2.BORDER_REFLECT)


def features(image, valid=None):
    return VERIFIER.found(image, valid)


def test_two_views_of_one_scene_agree_and_their_points_are_where_the_views_put_them():
    image = scene(0)
    check = epipolar_check(features(image), features(view(image, (30, -20), 1.1)), 0.75)
    assert check.inliers > 60
    assert check.spread > 0.3
    expected = check.query * 1.1 + np.array([30, -20]) / 640
    error = np.linalg.norm(expected - check.reference, axis=1)[check.inlier]
    assert np.median(error) < 1.0 / 320  # two pixels


def test_other_scenes_agree_by_chance_only():
    for seed in range(5):
        assert epipolar_check(features(scene(seed)), features(scene(seed + 50)), 0.75).inliers <= 12


@pytest.mark.parametrize("counts", [(40, 30), (2, 5), (60, 60)])
def test_matches_are_mutual_and_distinct_by_definition(counts):
    rng = np.random.default_rng(sum(counts))
    shared = rng.normal(size=(max(counts), 8))
    one, other = (
        LocalFeatures(np.zeros((n, 2), np.float32), _unit(shared[:n] + 0.6 * rng.normal(size=(n, 8)))) for n in counts
    )
    similarity = one.descriptors @ other.descriptors.T
    expected = []
    for i, row in enumerate(similarity):
        j = int(row.argmax())
        if similarity[:, j].argmax() == i:
            taken = similarity.copy()  # what is matched already is no second best
            for a, b in enumerate(similarity.argmax(1)):
                if similarity[:, b].argmax() == a:
                    taken[a, b] = -1.0
            second = max(taken[i].max(), taken[:, j].max())
            expected.append((i, j, bool(1 - row[j] < 0.81 * (1 - second) and second < 0.965)))
    *matches, nearest = match(one, other)
    assert list(zip(*(side.tolist() for side in matches), strict=True)) == expected
    assert nearest == pytest.approx(similarity.max(1), abs=1e-5)


def test_matches_beside_rivals_are_those_that_no_other_place_has_as_near():
    rng = np.random.default_rng(5)
    rows = _unit(rng.normal(size=(40, 16)))

    def seen(numbers, noise):
        changed = _unit(rows[numbers] + noise * rng.normal(size=(len(numbers), 16)))
        return LocalFeatures(rng.uniform(size=(len(numbers), 2)).astype(np.float32), changed)

    query = LocalFeatures(rng.uniform(size=(40, 2)).astype(np.float32), rows)
    here = epipolar_check(query, seen(np.arange(40), 0.02), 0.75)
    rival = epipolar_check(query, seen(np.arange(25, 40), 0.01), 0.75)  # has fifteen of them, and nearer
    assert here.matches_beside([]) == 40
    assert here.matches_beside([rival]) == 25
    assert rival.matches_beside([here]) <= 15


def _unit(rows):
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def test_a_blank_picture_has_no_features_and_agrees_with_nothing():
    blank = np.full((480, 640, 3), 90, np.uint8)
    assert len(features(blank).points) == 0
    assert epipolar_check(features(blank), features(scene(0)), 0.75).inliers == 0
    assert epipolar_check(features(blank), features(blank), 0.75).spread == 0.0


def test_a_damaged_picture_of_a_map_agrees_with_nothing():
    damaged = b"\xff\xd8\xff no picture"
    assert VERIFIER.check(VERIFIER.keep(scene(0), "front"), "front", damaged, "front").inliers == 0


def test_a_repeated_pattern_is_no_evidence():
    tile = scene(3, (48, 64))
    tiled = np.tile(tile, (10, 10, 1))
    other = np.roll(tiled, (17, 23), axis=(0, 1))
    assert epipolar_check(features(tiled), features(other), 0.75).inliers <= 20


def test_the_robots_own_body_is_no_evidence():
    body = scene(9)[240:]
    one, other = scene(1), scene(2)
    one[240:], other[240:] = body, body
    valid = np.ones(one.shape[:2], bool)
    assert epipolar_check(features(one), features(other), 0.75).inliers > 30
    valid[240:] = False
    kept = [VERIFIER.keep(image, "front", valid) for image in (one, other)]
    assert VERIFIER.check(kept[0], "front", kept[1], "front").inliers <= 12


def test_a_thumbnail_is_small_grey_and_of_the_same_aspect():
    picture = thumbnail(scene(0, (360, 640)))
    assert len(picture) < 20_000
    assert cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_UNCHANGED).shape == (180, 320)
    assert cv2.imdecode(np.frombuffer(thumbnail(scene(0, (60, 80))), np.uint8), cv2.IMREAD_UNCHANGED).shape == (60, 80)


@pytest.mark.parametrize("shape", [(16384, 16), (20000, 1), (1, 1), (16, 16384), (70000, 2)])
def test_a_sliver_of_an_image_stays_small(shape):
    """Its picture at 320 pixels width would have up to 6.4 million rows."""
    rgb = np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)
    picture = cv2.imdecode(np.frombuffer(thumbnail(rgb), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture.size <= 320 * 1280
    assert (VERIFIER.features(VERIFIER.keep(rgb, "front"))[0].points <= 4.0).all()


def test_likeness_is_that_of_a_plain_search_and_parts_a_place_in_another_light_from_other_places():
    """The distance of a feature to its own image's most similar one, over that of mutual nearest neighbours."""

    def plain(one, other):
        apart = 1 - one.descriptors.astype(float) @ other.descriptors.astype(float).T
        q, r = apart.argmin(1), apart.argmin(0)
        matched = np.mean([apart[i, q[i]] for i in range(len(q)) if r[q[i]] == i])
        own = []
        for image in (one, other):
            to_own = 1 - image.descriptors.astype(float) @ image.descriptors.astype(float).T
            own.append(np.mean([min(np.delete(row, i)) for i, row in enumerate(to_own)]))
        return np.log(np.mean(own) / matched)

    dark = (view(scene(0), (12, 5), 1.05) * 0.35).astype(np.uint8)
    again, elsewhere = (epipolar_check(features(scene(0)), features(image), 0.75) for image in (dark, scene(51)))
    for check, image in ((again, dark), (elsewhere, scene(51))):
        assert check.likeness == pytest.approx(plain(features(scene(0)), features(image)), abs=1e-3)
    assert again.likeness > elsewhere.likeness + 0.3
    assert epipolar_check(features(np.zeros_like(dark)), features(dark), 0.75).likeness == -2.0

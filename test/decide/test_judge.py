"""What the judge knows of a candidate beside the pair itself."""

import numpy as np
import pytest

from pnv_core.recognizer import PlaceRecognizer
from pnv_core.types import Frame
from test.core.small import noise_image, small_describer

S = 1_000_000_000


@pytest.mark.parametrize("places", [8, 40])
def test_the_background_is_the_fifth_most_similar_keyframe_elsewhere(places):
    describer = small_describer(min_interval_s=0.0, min_change=0.0, exclude_recent_s=5.0, verify=0, candidates=4)
    recognizer = PlaceRecognizer(describer)
    images = [noise_image(seed) for seed in range(places)]
    for i, image in enumerate(images):
        recognizer.process(Frame(i * S, "front", image))
    found = recognizer.process(Frame(1000 * S, "front", noise_image(3)))
    vectors = np.array([describer.describe(image).global_vector for image in images])
    similarity = vectors @ describer.describe(noise_image(3)).global_vector
    assert len(found) == 4
    for closure in found:
        elsewhere = sorted((s for i, s in enumerate(similarity) if abs(i - closure.match.id) > 10), reverse=True)
        middle = sorted(similarity, reverse=True)[places // 2]  # what counts where all of eight are neighbours
        expected = max(elsewhere[4], middle) if elsewhere else middle
        assert closure.evidence.background == pytest.approx(expected, abs=1e-5)

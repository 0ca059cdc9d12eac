"""What stamps tell of the middleware's losses; the truth is what the test leaves out."""

import numpy as np
import pytest

from pnv_ros.losses import TransportLosses, profile

TOPIC = "camera/image_raw"


def arrivals(rate, kept, frames=600, jitter=0.05, seed=0):
    """Losses after stamps of a camera of `rate` Hz, of which a share `kept` arrives at random."""
    rng = np.random.default_rng(seed)
    losses = TransportLosses()
    for number in np.flatnonzero(rng.random(frames) < kept):
        losses.arrived(TOPIC, int(1e9 * (100 + (number + jitter * rng.uniform(-1, 1)) / rate)))
    return losses


@pytest.mark.parametrize("rate", [10, 30, 60])
@pytest.mark.parametrize("kept", [0.33, 0.55, 0.8])
def test_the_share_that_is_lost_is_told_from_the_stamps(rate, kept):
    assert arrivals(rate, kept).share(TOPIC) == pytest.approx(1 - kept, abs=0.12)


@pytest.mark.parametrize("jitter", [0.0, 0.1, 0.2])
def test_a_camera_that_arrives_whole_is_left_alone(jitter):
    losses = arrivals(30, 1.0, jitter=jitter)
    assert losses.share(TOPIC) == 0.0
    assert losses.sentence(TOPIC) == ""


def test_a_loss_is_said_with_the_profile_that_is_there():
    said = arrivals(30, 0.4).sentence(TOPIC)
    assert "of the frames of camera/image_raw" in said
    assert f"FASTRTPS_DEFAULT_PROFILES_FILE={profile()}" in said
    assert "<segment_size>" in profile().read_text()


def test_too_few_frames_and_a_run_that_begins_anew_say_nothing():
    losses = arrivals(30, 0.4, frames=100)
    assert losses.share(TOPIC) == 0.0
    losses = arrivals(30, 0.4)
    losses.arrived(TOPIC, 0)
    assert losses.share(TOPIC) == 0.0

"""What ARCHITECTURE.md promises of adding parts: a program adds a trunk and a verifier without touching a file."""

import numpy as np
import pytest

from pnv_core import Config, Describer, Frame, PlaceRecognizer
from pnv_core.describe.model_files import ModelInfo, build_model, load_model, save_model
from pnv_core.describe.trunks import TRUNKS
from pnv_core.describe.trunks.trunk import Trunk
from pnv_core.errors import ConfigError, ModelError
from pnv_core.networks.layers import AvgPool, Crop, SpaceToDepth
from pnv_core.verify.verifier import VERIFIERS, EpipolarCheck

EVERY_FRAME = {"min_interval_s": 0.0, "min_change": 0.0, "exclude_recent_s": 10.0, "threads": 1}


def quarters():
    """Mean colours of the four quarters of each 14 px square: stride 14, which no shipped trunk has."""
    return Trunk((Crop(14), AvgPool(7, 7), SpaceToDepth(2)), stride=14)


class SamePicture:
    """Keeps the mean of every 32nd row and agrees on as many points as there are equal means."""

    side = 32

    def __init__(self, config):
        pass

    def keep(self, rgb, camera, valid=None):
        return rgb[::32].mean((1, 2)).astype(np.float32).tobytes()

    def prepare(self, kept, workers):
        pass

    def check(self, query, query_camera, reference, reference_camera):
        a, b = np.frombuffer(query, np.float32), np.frombuffer(reference, np.float32)
        points = np.linspace(0, 1, 2 * len(a), dtype=np.float32).reshape(-1, 2)
        return EpipolarCheck(points, points, np.abs(a - b) < 1e-3, spread=0.5)


@pytest.fixture
def toy_model():
    TRUNKS.register("quarters", quarters)
    rng = np.random.default_rng(0)
    tensors = {
        "netvlad.centroids": rng.random((4, 12)),
        "netvlad.assignment": rng.normal(size=(4, 12)) * 5,
        "global_projection.weight": rng.normal(size=(16, 48)),
        "global_projection.bias": np.zeros(16),
    }
    info = ModelInfo("quarters", image_width=210, image_height=140, patch_sizes=(2,), patch_weights=(1.0,))
    return build_model(info, tensors, "toy model")


def test_a_trunk_of_another_stride_describes_matches_and_is_saved(toy_model, tmp_path):
    save_model(toy_model, tmp_path / "toy.safetensors")
    describer = Describer(load_model(tmp_path / "toy.safetensors"), Config(threads=1))
    rng = np.random.default_rng(0)
    grid = describer.describe(rng.integers(0, 256, (140, 210, 3), np.uint8)).patches[0]
    assert (grid.rows, grid.cols, grid.cell) == (140 // 14 - 1, 210 // 14 - 1, 14)
    # cells 0 and 1 of 14 px: their common centre lies between pixels 13 and 14
    assert grid.keypoints()[0].tolist() == [13, 13]
    assert grid.keypoints()[-1].tolist() == [210 - 15, 140 - 15]


def test_a_shift_by_one_cell_is_found_in_pixels_of_that_stride(toy_model):
    wide = np.random.default_rng(1).integers(0, 256, (20, 32, 3), np.uint8).repeat(7, 0).repeat(7, 1)  # (140, 224, 3)
    recognizer = PlaceRecognizer(Describer(toy_model, Config(**EVERY_FRAME)))
    for second, left in ((0, 0), (60, 14)):
        frame = Frame(second * 10**9, "front", np.ascontiguousarray(wide[:, left : left + 210]))
        closures = recognizer.process(frame)
    (matches,) = closures[0].matches
    moved = (matches.reference_xy - matches.query_xy)[matches.inlier]
    assert len(moved) > 100
    assert (moved == [14, 0]).all()
    assert recognizer.database.descriptor(0).patches[0].cell == 14


def test_a_verifier_from_outside_is_asked_and_believed(toy_model):
    VERIFIERS.register("same picture", SamePicture)
    recognizer = PlaceRecognizer(Describer(toy_model, Config(verifier="same picture", **EVERY_FRAME)))
    image = np.random.default_rng(2).integers(0, 256, (140, 210, 3), np.uint8)
    recognizer.process(Frame(0, "front", image))
    (closure,) = recognizer.process(Frame(60 * 10**9, "front", image))
    assert closure.evidence.local_inliers == len(range(0, 140, 32))
    assert closure.evidence.local_spread == 0.5


def test_unknown_parts_are_refused_by_name(toy_model):
    with pytest.raises(ModelError, match=r"trunk = 'resnet' is not known; allowed: one of vgg16, .*rootsift"):
        TRUNKS.make("resnet")
    with pytest.raises(ConfigError, match=r"verifier = 'eyes' is not known; allowed: one of xfeat"):
        PlaceRecognizer(Describer(toy_model, Config(verifier="eyes", threads=1)))
    with pytest.raises(ConfigError, match=r"index = 'tree' is not known; allowed: one of auto, exact, pq"):
        PlaceRecognizer(Describer(toy_model, Config(index="tree", threads=1)))

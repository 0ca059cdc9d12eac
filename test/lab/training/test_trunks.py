import numpy as np
import pytest
import torch

from pnv_core.describe.torch_model import TorchTrunk
from pnv_core.describe.trunks.lite import lite_trunk
from pnv_core.describe.trunks.rootsift import rootsift_trunk


def lite(variant, **options):
    return TorchTrunk(lite_trunk(variant, **options))


def rootsift():
    return TorchTrunk(rootsift_trunk())


@pytest.mark.parametrize("trunk", [lite(1), lite(0, neck=0), lite(0, deep=True), rootsift()])
@pytest.mark.parametrize("size", [(480, 640), (240, 320), (100, 131)])
def test_a_map_has_one_cell_per_sixteen_pixels(trunk, size):
    with torch.inference_mode():
        features = trunk(torch.rand(1, 3, *size))
    assert features.shape == (1, trunk.channels, size[0] // 16, size[1] // 16)


@pytest.mark.parametrize("trunk", [lite(0, neck=0), lite(1, neck=0)])
def test_a_cell_looks_at_pixels_around_its_centre(trunk):
    """VGG16's cell i is centred at pixel 16 i + 7: keypoints of both trunks mean the same."""
    torch.manual_seed(0)
    images = torch.rand(1, 3, 640, 640, dtype=torch.float64, requires_grad=True)
    trunk.double()(images)[0, :, 20, 19].sum().backward()
    touched = images.grad.abs().sum((0, 1))
    rows, cols = torch.nonzero(touched.sum(1)).flatten(), torch.nonzero(touched.sum(0)).flatten()
    assert (rows.min() + rows.max()) / 2 == 16 * 20 + 7
    assert (cols.min() + cols.max()) / 2 == 16 * 19 + 7


def test_front_and_back_make_the_whole_trunk():
    trunk = lite(0, deep=True).eval()
    images = torch.rand(2, 3, 96, 112)
    with torch.inference_mode():
        maps = trunk.front(images, 9)
        features, wide, deep = trunk.back(maps, 9)
        assert torch.equal(features, trunk(images))
        assert torch.equal(wide, trunk.wide(maps, 9))
        assert torch.equal(trunk.run(wide, len(trunk.trunk.layers)), features)
        assert deep.shape[1:] == trunk.trunk.pooled_shape(features.shape[2:]) == (1280, 3, 3)


def test_rootsift_ignores_brightness_and_contrast():
    torch.manual_seed(1)
    image = torch.rand(1, 3, 64, 64)
    with torch.inference_mode():
        plain, dimmed = rootsift()(image), rootsift()(0.2 + 0.5 * image)
    assert torch.allclose(plain, dimmed, atol=1e-4)
    assert torch.allclose(plain.norm(dim=1), torch.ones(1, 4, 4), atol=1e-3)


def test_rootsift_of_a_blank_image_is_zero():
    with torch.inference_mode():
        assert rootsift()(torch.full((1, 3, 64, 64), 0.4)).abs().max() < 1e-2


def test_rootsift_equals_a_histogram_counted_pixel_by_pixel():
    """Brute force in float64: one descriptor, bins of 8 px shared bilinearly, orientation shared linearly."""
    rng = np.random.default_rng(2)
    image = rng.random((80, 80))
    kernel = np.exp(-0.5 * np.arange(-2, 3) ** 2 / 0.8**2)
    kernel /= kernel.sum()
    padded = np.pad(image, 2, mode="edge")
    grey = sum(kernel[i] * kernel[j] * padded[i : i + 80, j : j + 80] for i in range(5) for j in range(5))
    around = np.pad(grey, 1, mode="edge")
    dx, dy = (around[1:-1, 2:] - around[1:-1, :-2]) / 2, (around[2:, 1:-1] - around[:-2, 1:-1]) / 2
    centre = 16 * 2 + 7.5
    histogram = np.zeros((8, 4, 4))
    for y in range(80):
        for x in range(80):
            turn = np.arctan2(dy[y, x], dx[y, x]) / (np.pi / 4) % 8
            for by in range(4):
                for bx in range(4):
                    share_y = max(0, 1 - abs(y - (centre + 8 * (by - 1.5))) / 8)
                    share_x = max(0, 1 - abs(x - (centre + 8 * (bx - 1.5))) / 8)
                    if share_y * share_x:
                        for o, part in ((int(turn) % 8, 1 - turn % 1), ((int(turn) + 1) % 8, turn % 1)):
                            histogram[o, by, bx] += part * np.hypot(dx[y, x], dy[y, x]) * share_y * share_x
    sift = (histogram / np.linalg.norm(histogram)).clip(max=0.2).ravel()
    expected = np.sqrt(sift / sift.sum())
    with torch.inference_mode():
        images = torch.from_numpy(image).float()[None, None].expand(1, 3, -1, -1)
        found = rootsift()(images)[0, :, 2, 2].double().numpy()
    assert np.abs(found - expected).max() < 1e-4

"""The part of the global vector beside the VLAD; oracle: NumPy, cell by cell."""

import numpy as np
import pytest
import torch

from pnv_core.config import Config
from pnv_core.describe.describer import Describer
from pnv_core.describe.model_files import Model, ModelInfo, load_model, save_model
from pnv_core.describe.netvlad import NetVLAD, Projection, gem
from pnv_core.describe.torch_model import TorchModel, TorchTrunk
from pnv_core.describe.trunks.lite import lite_trunk
from pnv_core.errors import ModelError

WIDTH, HEIGHT = 96, 80


def counted_mean(maps: np.ndarray, weights: np.ndarray) -> np.ndarray:
    channels = [sum(w * max(v, 1e-6) ** 3 for v, w in zip(c.ravel(), weights.ravel(), strict=True)) for c in maps]
    root = np.array(channels) ** (1 / 3)
    return root / np.linalg.norm(root)


def pooled_model(deep: bool = True, middle: bool = False) -> Model:
    torch.manual_seed(4)
    options = {"variant": 0, "neck": 8, "deep": deep}
    trunk = TorchTrunk(lite_trunk(**options))
    parts = [NetVLAD(3, 8), Projection(24, 6), Projection(24, 5), Projection(trunk.trunk.pooled_width, 4)]
    parts += [Projection(trunk.width, 3)] if middle else []
    for part in parts:
        for parameter in part.parameters():
            torch.nn.init.normal_(parameter)
    info = ModelInfo("lite", options, WIDTH, HEIGHT, (2,), (1.0,), middle_share=0.2 if middle else 0.0)
    return TorchModel(info, trunk, *parts).model()


def image(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


@pytest.mark.parametrize("masked", [False, True])
def test_generalised_mean_counts_cells_by_their_weight(masked):
    rng = np.random.default_rng(1)
    maps = rng.normal(size=(1, 7, 4, 5))
    weights = rng.uniform(0, 1, 20) if masked else np.ones(20)
    found = gem(torch.from_numpy(maps), torch.from_numpy(weights)[None] if masked else None)
    assert np.allclose(found[0].numpy(), counted_mean(maps[0], weights), atol=1e-6)


@pytest.mark.parametrize(("deep", "middle"), [(False, False), (True, False), (True, True)])
@pytest.mark.parametrize("backend", ["openvino", "torch"])
def test_the_global_vector_is_the_projected_vlad_beside_the_projected_means(deep, middle, backend):
    model = pooled_model(deep, middle)
    describer = Describer(model, Config.make(weights="x", backend=backend))
    vector = describer.describe(image(0)).global_vector.astype(np.float64)
    features, wide, last = describer.maps(image(0))
    with torch.inference_mode():
        vlad = TorchModel.of(model).netvlad(torch.from_numpy(features)[None])[0].double().numpy()
    means = [counted_mean(maps.astype(np.float64), np.ones(maps[0].size)) for maps in (last, wide)]
    given = [("global_projection", vlad, 0.3 if middle else 0.5), ("pooled_projection", means[0], 0.5)]
    given += [("middle_projection", means[1], 0.2)] if middle else []
    parts = []
    for part, inputs, share in given:
        weight, bias = (model.tensors[f"{part}.{name}"].astype(np.float64) for name in ("weight", "bias"))
        raw = weight @ inputs + bias
        parts.append(np.sqrt(share) * raw / np.linalg.norm(raw))
    assert np.allclose(vector, np.concatenate(parts), atol=1e-5)
    assert model.global_dim == len(vector) == (13 if middle else 10)


def test_a_mask_hides_cells_from_the_pooled_half_too():
    """What changes well under the mask moves the vector by a tenth of what it does without one, or less."""
    describer = Describer(pooled_model(deep=False), Config(trunk_precision="float32"))  # two vectors are nearly equal
    first, second = image(1), image(1)
    second[64:] = 0
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[16:] = False
    moved = [
        np.linalg.norm(np.subtract(*(describer.describe(i, mask).global_vector[6:] for i in (first, second))))
        for mask in (valid, None)
    ]
    assert moved[0] < 0.1 * moved[1]


def test_a_model_file_keeps_the_pooled_parts(tmp_path):
    model = pooled_model(middle=True)
    save_model(model, tmp_path / "model.safetensors")
    again = load_model(tmp_path / "model.safetensors")
    assert again.fingerprint() == model.fingerprint()
    assert np.array_equal(Describer(again).describe(image(3)).global_vector,
                          Describer(model).describe(image(3)).global_vector)  # fmt: skip
    wrong = Model(model.info, model.tensors | {"pooled_projection.weight": np.zeros((4, 24), np.float32)})
    with pytest.raises(ModelError, match="pooled_projection"):
        save_model(wrong, tmp_path / "wrong.safetensors")
    with pytest.raises(ModelError, match=r"pooled_share \+ middle_share = 1.1; allowed: up to 1"):
        save_model(model.with_info(middle_share=0.6), tmp_path / "wrong.safetensors")
    assert model.with_info(middle_share=0.3).fingerprint() != model.fingerprint()


def test_both_backends_count_the_cells_of_a_deep_map_alike():
    """At 15 x 21 cells a mask's last row and column have no partner in the map of half the size."""
    model, mask = pooled_model(middle=True).with_info(image_width=336, image_height=240), np.ones((240, 336), bool)
    mask[:100, 200:] = False
    rgb = np.random.default_rng(5).integers(0, 256, (240, 336, 3), np.uint8)
    configs = (Config.make(weights="x", backend=backend) for backend in ("openvino", "torch"))
    vectors = [Describer(model, config).describe(rgb, mask).global_vector for config in configs]
    assert np.allclose(*vectors, atol=1e-3)

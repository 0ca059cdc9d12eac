from pathlib import Path

from pnv_core.describe.download import DEFAULT_MODEL
from pnv_core.describe.model_files import load_model


def test_the_shipped_model_is_small_trained_and_has_a_card():
    model = load_model(DEFAULT_MODEL)
    assert DEFAULT_MODEL.stat().st_size < 20e6
    assert model.info.trunk == "lite"
    assert model.has("patch_projection")
    assert "pnv train" in model.info.provenance
    assert "pnv train" in (Path(DEFAULT_MODEL).parent / "MODEL_CARD.md").read_text()


def test_a_keyframe_of_the_default_model_takes_less_than_256_kb():
    model = load_model(DEFAULT_MODEL)
    rows, cols = model.info.image_height // 16, model.info.image_width // 16
    patches = sum((rows - p + 1) * (cols - p + 1) for p in model.info.patch_sizes)
    assert 4 * model.global_dim + 2 * patches * model.patch_dim < 256 * 1024

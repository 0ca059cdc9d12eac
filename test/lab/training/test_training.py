from dataclasses import replace

import numpy as np
import pytest
import torch

from pnv_core.describe.model_files import ModelInfo
from pnv_core.describe.netvlad import NetVLAD
from pnv_core.describe.torch_model import TorchTrunk
from pnv_core.describe.trunks.trunk import Trunk
from pnv_core.errors import ModelError
from pnv_core.networks.layers import Conv
from pnv_lab.fit import FitOptions, learned_whitening
from pnv_lab.training.augment import SampledCamera, flat_view, panorama_view, relight
from pnv_lab.training.batches import BatchOptions, PlaceBatches
from pnv_lab.training.initial import imagenet_trunk, initial_model
from pnv_lab.training.pool import FeaturePool
from pnv_lab.training.sources import PlaceImage, load_set, relation
from pnv_lab.training.trainer import Trainer, TrainOptions
from pnv_lab.training.triplets import TripletOptions, TripletTrainer
from pnv_lab.training.validation import synthetic_queries

VIEW = (96, 80)


class Killed(Exception):
    pass


def killed_after(steps):
    """A progress that dies like a process would, in the middle of a training."""

    def progress(items, done, total):
        for count, item in enumerate(items):
            if count == steps:
                raise Killed
            yield item

    return progress


@pytest.fixture
def pool(picture_folder, imagenet_file, tmp_path):
    drawn = PlaceBatches(load_set(picture_folder), BatchOptions(places=4, views=3, neighbours=2, sizes=(VIEW,)))
    made = FeaturePool(tmp_path / "pool", drawn, groups=3, places=4, views=2)
    made.build(imagenet_trunk(imagenet_file, 1, deep=True), 16)
    return made


def trainer(pool, imagenet_file, folder, **changes):
    info = ModelInfo("lite", {"variant": 1, "neck": 12, "deep": True}, *VIEW, (2,), (1.0,))
    fit = FitOptions(
        clusters=3, global_dim=6, pooled_dim=3, patch_dim=5, image_width=96, image_height=80, patch_sizes=(2,)
    )
    model = initial_model(imagenet_trunk(imagenet_file, 1, deep=True), 12, pool, 16, info, fit)
    options = TrainOptions(
        steps=6,
        warmup=2,
        frozen_layers=16,
        patch_sizes=(2,),
        patch_pairs=3,
        save_every=2,
        validate_every=6,
        mixed=False,
    )
    return Trainer(model, pool, [], replace(options, **changes), folder)


def test_a_training_that_was_killed_ends_as_if_it_had_not_been(pool, imagenet_file, tmp_path):
    whole = trainer(pool, imagenet_file, tmp_path / "whole").run().tensors()
    with pytest.raises(Killed):
        trainer(pool, imagenet_file, tmp_path / "cut").run(killed_after(3))
    resumed = trainer(pool, imagenet_file, tmp_path / "cut")
    assert resumed.step == 2
    again = resumed.run().tensors()
    assert all(torch.allclose(whole[name], again[name], atol=1e-6) for name in whole)
    assert [row["step"] for row in resumed.journal.rows()] == [0, 2, 4, 6, 6]


@pytest.mark.parametrize("loss", ["ms", "ap"])
def test_training_lowers_the_loss(pool, imagenet_file, tmp_path, loss):
    run = trainer(pool, imagenet_file, tmp_path / "run", steps=40, save_every=10, average=0.9, patch_pairs=2, loss=loss)
    run.run()
    losses = [row["loss"] for row in run.journal.rows() if "loss" in row]
    assert losses[-1] < losses[0]


def test_a_checkpoint_of_other_settings_is_refused(pool, imagenet_file, tmp_path):
    trainer(pool, imagenet_file, tmp_path / "run", steps=2).run()
    with pytest.raises(ModelError, match="other settings"):
        trainer(pool, imagenet_file, tmp_path / "run", steps=3)


def test_frozen_layers_keep_their_weights(pool, imagenet_file, tmp_path):
    run = trainer(pool, imagenet_file, tmp_path / "run", trunk_lr=0.1, steps=2)
    before = {n: t.clone() for n, t in run.model.tensors().items()}
    after = run.run().tensors()
    assert torch.equal(before["trunk.blocks.14.project.weight"], after["trunk.blocks.14.project.weight"])
    assert not torch.equal(before["trunk.expand.weight"], after["trunk.expand.weight"])


def test_the_last_layer_is_never_frozen(pool, imagenet_file, tmp_path):
    before = trainer(pool, imagenet_file, tmp_path / "new").model.tensors()["trunk.expand.weight"].clone()
    few, many = (
        trainer(pool, imagenet_file, tmp_path / str(n), steps=1, warmup=0, frozen_layers=n).run().tensors()
        for n in (16, 99)
    )
    assert all(torch.equal(few[name], many[name]) for name in few)
    assert not torch.equal(before, few["trunk.expand.weight"])


def test_a_pool_gives_what_the_frozen_layers_give(pool, imagenet_file, picture_folder):
    trunk = imagenet_trunk(imagenet_file, 1, deep=True)
    origins, views = pool.batches.render(1)
    image = torch.from_numpy(views[4].pixels).permute(2, 0, 1)[None].float() / 255
    with torch.no_grad():
        expected = trunk.front(image, 16)[0].numpy()
    found = np.asarray(pool.maps[1 * len(views) + 4], np.float32)
    assert np.abs(found - expected).max() <= 0.02 * np.abs(expected).max()  # bfloat16 and float16
    assert [o.image.name for o in pool.origins[1]] == [o.image.name for o in origins]


def test_batches_repeat_and_know_which_pairs_are_places(picture_folder):
    batches = PlaceBatches(load_set(picture_folder), BatchOptions(places=4, views=2, neighbours=2, sizes=(VIEW,)))
    a, b, other = batches[7], batches[7], batches[8]
    assert torch.equal(a.inputs, b.inputs)
    assert not torch.equal(a.inputs, other.inputs)
    assert not (a.positive & a.negative).any()
    assert not a.positive.diagonal().any()
    assert a.positive[0, 1]
    assert a.scene[0] == a.scene[1]


def test_coordinates_say_where_a_view_comes_from():
    """A picture whose colours are its coordinates: what a cell shows is where it says it is."""
    ramp = np.zeros((240, 320, 3), np.uint8)
    ramp[..., 0] = np.linspace(0, 255, 320)[None]
    ramp[..., 1] = np.linspace(0, 255, 240)[:, None]
    for seed in range(5):
        view = flat_view(ramp, (320, 240), 1.0, False, np.random.default_rng(seed))
        shown = view.pixels[7::16, 7::16].astype(float) / 255 - 0.5
        inside = view.coordinates[..., 0] < 100
        assert inside.any()
        assert np.abs(view.coordinates[..., 0] / 20 - shown[..., 0])[inside].max() < 0.03
        assert np.abs(view.coordinates[..., 1] / 15 - shown[..., 1])[inside].max() < 0.03


def test_two_views_of_a_panorama_agree_on_directions():
    """A panorama whose colour is the yaw: equal colours have equal rays."""
    panorama = np.zeros((200, 400, 3), np.uint8)
    panorama[..., 0] = np.linspace(0, 255, 400)[None]
    rng = np.random.default_rng(0)
    view = panorama_view(panorama, (320, 240), SampledCamera(0.4, 0.0, 0.0, 1.2), 0.0, False, rng)
    yaw = np.arctan2(view.coordinates[..., 0], view.coordinates[..., 2])
    shown = (view.pixels[7::16, 7::16, 0] / 255 - 0.5) * 2 * np.pi
    assert np.abs(yaw - shown).max() < 0.06


def test_relighting_is_seeded_and_keeps_the_shape():
    image = np.random.default_rng(0).integers(0, 256, (80, 96, 3), dtype=np.uint8)
    for seed in range(30):
        first, second = (relight(image, 1.0, np.random.default_rng(seed), image) for _ in range(2))
        assert first.shape == image.shape
        assert first.dtype == np.uint8
        assert np.array_equal(first, second)


def place(sequence, index, set_name="icl_office_kt3_synth", family=None, pose=None):
    return PlaceImage("x", set_name, sequence, family or sequence, index, np.zeros((2, 2, 3), np.uint8), pose=pose)


def test_relations_follow_poses_and_aliases():
    here = place("s", 0, pose=(0, 0, 0, 0))
    assert relation(here, place("s", 300, pose=(0.2, 0, 0, 0.1))) == 1
    assert relation(here, place("s", 300, pose=(0, 0, 0, 3.0))) == -1
    assert relation(here, place("s", 300, pose=(1.0, 0, 0, 0))) == 0
    assert relation(here, place("other", 0)) == -1
    assert relation(place("floor3-v0", 0, "ie_tower", "floor3"), place("floor3-v1", 0, "ie_tower", "floor3")) == 0
    assert relation(place("floor3-v0", 0, "ie_tower", "floor3"), place("floor4-v0", 0, "ie_tower", "floor4")) == -1


def test_synthetic_validation_has_one_true_reference_per_query(picture_folder):
    known = synthetic_queries("walks", load_set(picture_folder), VIEW, 20, 1)
    assert known.queries.shape == known.references.shape == (12, 80, 96, 3)
    assert (known.true.sum(1) == 1).all()
    assert (known.true & known.counted).any(1).all()


def tiny_trunk():
    torch.manual_seed(0)
    return TorchTrunk(Trunk((Conv("features.0", 6, 16, 16),)))


def test_triplet_training_resumes_at_the_last_cache(picture_folder, tmp_path):
    def make(folder):
        torch.manual_seed(1)
        netvlad = NetVLAD(3, 6)
        torch.nn.init.normal_(netvlad.centroids)
        torch.nn.init.normal_(netvlad.assignment)
        options = TripletOptions(epochs=2, width=96, height=80, cache_queries=4, rate=0.01, first_layer=0, mixed=False)
        return TripletTrainer(tiny_trunk(), netvlad, load_set(picture_folder), [], options, folder)

    whole = make(tmp_path / "whole")
    whole.run()
    cut = make(tmp_path / "cut")
    with pytest.raises(Killed):
        cut.run(killed_after(4))
    resumed = make(tmp_path / "cut")
    assert resumed.chunk == 4
    resumed.run()
    expected, found = whole.parts.state_dict(), resumed.parts.state_dict()
    assert all(torch.allclose(expected[name], found[name], atol=1e-6) for name in expected)
    assert sum(row["tuples"] for row in resumed.journal.rows()) > 0


def test_a_pool_of_other_images_seed_layers_or_size_is_not_taken_for_this_one(pool, imagenet_file, picture_folder):
    """Whatever lies in the folder, a pool's maps are those of its own views."""
    trunk = imagenet_trunk(imagenet_file, 1, deep=True)
    images, options = pool.batches.images, pool.batches.options
    changes = {
        "images": (PlaceBatches(images[1:], options), 3, 16),
        "seed": (PlaceBatches(images, replace(options, seed=options.seed + 1)), 3, 16),
        "larger": (pool.batches, 4, 16),
        "layers": (pool.batches, 3, 8),
    }
    for name, (batches, groups, layers) in changes.items():
        other = FeaturePool(pool.folder, batches, groups, places=4, views=2)
        other.build(trunk, layers)
        for group in range(groups):
            _, views = batches.render(group)
            pixels = torch.from_numpy(np.stack([v.pixels for v in views])).permute(0, 3, 1, 2).float() / 255
            with torch.inference_mode():
                maps = trunk.front(pixels, layers).numpy()
            found = np.asarray(other.maps[group * len(views) : (group + 1) * len(views)], np.float32)
            assert np.abs(found - maps).max() < 1e-3 * np.abs(maps).max(), name
    again = FeaturePool(pool.folder, pool.batches, 3, places=4, views=2)
    pool.batches.render = lambda number: pytest.fail("what lies there was not used")
    again.build(trunk, 16)
    assert np.array_equal(again.maps, pool.maps)


def test_an_imagenet_file_is_read_with_its_batch_norms_folded(imagenet_file):
    """Oracle: the stem and the first depthwise convolution with torch's own batch norm, in float64."""
    tensors = {n: t.double() for n, t in torch.load(imagenet_file, weights_only=True).items()}
    image = torch.rand(1, 3, 64, 64, dtype=torch.float64)

    def normed(x, norm):
        return torch.batch_norm(
            x, tensors[f"{norm}.weight"], tensors[f"{norm}.bias"], tensors[f"{norm}.running_mean"],
            tensors[f"{norm}.running_var"], False, 0.0, 1e-3, False,
        )  # fmt: skip

    x = torch.nn.functional.pad((255 * image - 127) / 128, (0, 1, 0, 1))
    x = normed(torch.conv2d(x, tensors["_conv_stem.weight"], stride=2), "_bn0").clamp(0, 6)
    x = normed(torch.conv2d(x, tensors["_blocks.0._depthwise_conv.weight"], padding=1, groups=32), "_blocks.0._bn1")
    expected = normed(torch.conv2d(x.clamp(0, 6), tensors["_blocks.0._project_conv.weight"]), "_blocks.0._bn2")
    found = imagenet_trunk(imagenet_file, 1, deep=True).double().front(image, 2)
    assert torch.allclose(found, expected, atol=1e-6)


def test_learned_whitening_makes_the_scatter_within_places_white():
    """And keeps the directions in which places differ most; oracle: NumPy."""
    rng = np.random.default_rng(0)
    mixing = rng.normal(size=(6, 6))
    centres = rng.normal(size=(400, 6)) * np.array([5, 4, 3, 2, 1, 0.5])
    places = np.repeat(np.arange(400), 3)
    samples = (centres[places] + rng.normal(size=(1200, 6))) @ mixing.T
    weight, bias = learned_whitening(torch.tensor(samples).float(), torch.tensor(places), 4, shrinkage=0.0)
    found = samples @ weight.numpy().T + bias.numpy()
    means = np.array([found[places == p].mean(0) for p in range(400)])
    within = found - means[places]
    scatter = within.T @ within
    assert np.allclose(scatter / scatter.trace() * 4, np.eye(4), atol=0.02)
    between = np.cov(found.T)
    assert np.allclose(between, np.diag(np.diag(between)), atol=0.02 * between.max())
    assert (np.diff(np.diag(between)) <= 0).all()
    assert np.abs(found.mean(0)).max() < 1e-3
    with pytest.raises(ModelError, match="second views"):
        learned_whitening(torch.tensor(samples).float(), torch.arange(1200), 4)

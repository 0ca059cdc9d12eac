from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from pnv_core.describe.model_files import ModelInfo, load_model, save_model
from pnv_core.describe.netvlad import Projection, alpha_rule
from pnv_core.describe.torch_model import TorchTrunk
from pnv_core.describe.trunks.rootsift import rootsift_trunk
from pnv_core.errors import ModelError
from pnv_lab.fit import (
    FitOptions,
    adapted_projection,
    alike,
    fit_model,
    image_files,
    neighbours,
    neighbours_by_pose,
    pca,
    spherical_kmeans,
)
from pnv_lab.poses import read_poses


def test_kmeans_finds_directions_that_are_there():
    generator = torch.Generator().manual_seed(0)
    true = F.normalize(torch.randn(5, 20, generator=generator), dim=1)
    samples = F.normalize(true.repeat(60, 1) + 0.05 * torch.randn(300, 20, generator=generator), dim=1)
    found = F.normalize(spherical_kmeans(samples, 5, generator), dim=1)
    assert (found @ true.T).amax(0).min() > 0.99


def test_alpha_rule_leaves_a_hundredth_to_the_second_best_cluster():
    samples = F.normalize(torch.randn(500, 8, generator=torch.Generator().manual_seed(1)), dim=1)
    logits = samples @ alpha_rule(samples[:6] * 0.9, samples).T
    top = torch.softmax(logits, dim=1).topk(2, dim=1).values
    assert torch.log(top[:, 1] / top[:, 0]).mean().item() == pytest.approx(np.log(0.01), rel=1e-4)


@pytest.mark.parametrize("shape", [(400, 30), (40, 90)])
def test_whitened_pca_has_unit_variance_and_plain_pca_keeps_lengths(shape):
    samples = torch.randn(shape, generator=torch.Generator().manual_seed(2)) * torch.linspace(1, 3, shape[1]) + 5
    weight, bias = pca(samples, 10, whiten=True)
    whitened = samples @ weight.T + bias
    assert torch.allclose(torch.cov(whitened.T), torch.eye(10), atol=1e-3)
    weight, _ = pca(samples, 10, whiten=False)
    assert torch.allclose(weight @ weight.T, torch.eye(10), atol=1e-4)


def test_too_few_samples_are_refused_by_number():
    with pytest.raises(ModelError, match="5 samples .* 10 dimensions; allowed: at most 4"):
        pca(torch.randn(5, 20), 10, whiten=True)


def test_a_rootsift_model_is_fitted_saved_and_loaded(picture_folder, tmp_path):
    options = FitOptions(
        clusters=4,
        global_dim=3,
        patch_dim=6,
        image_width=128,
        image_height=96,
        patch_sizes=(2, 3),
        patch_weights=(0.5, 0.5),
    )
    model = fit_model(TorchTrunk(rootsift_trunk()), ModelInfo("rootsift"), image_files([picture_folder]), options)
    save_model(model.model(), tmp_path / "m.safetensors")
    again = load_model(tmp_path / "m.safetensors")
    assert (again.clusters, again.global_dim, again.patch_dim) == (4, 3, 6)
    assert again.info.patch_sizes == (2, 3)


def test_adapting_whitens_how_two_looks_at_a_place_differ():
    """Looks differ five times as much along the first axis; oracle: their covariance is isotropic afterwards."""
    generator = torch.Generator().manual_seed(4)
    places = torch.randn(300, 6, generator=generator)
    looks = [places + torch.randn(300, 6, generator=generator) * torch.tensor([5.0, 1, 1, 1, 1, 1]) for _ in "ab"]
    pairs = torch.arange(300)[:, None] + torch.tensor([0, 300])
    identity = Projection(6, 6)
    identity.load_state_dict({"weight": torch.eye(6), "bias": torch.ones(6)})
    white = adapted_projection(identity, torch.cat(looks), pairs, least=0.0)
    apart = (looks[0] - looks[1]) @ white.weight.T
    assert torch.allclose(apart.T @ apart / 600, torch.eye(6) * (apart**2).sum() / 3600, atol=1e-3)
    kept = adapted_projection(identity, torch.cat(looks), pairs, least=1.0)
    assert torch.allclose(kept.weight, torch.eye(6), atol=1e-5)
    assert torch.allclose(kept.bias, torch.ones(6), atol=1e-5)


def test_pairs_follow_one_another_in_a_folder_or_are_near_by_pose(tmp_path):
    files = [Path("a/0.png"), Path("a/1.png"), Path("b/2.png"), Path("b/3.png")]
    assert neighbours(files).tolist() == [[0, 1], [2, 3]]
    csv = tmp_path / "poses.csv"
    csv.write_text("frame,x,y,yaw\n0.png,0,0,0\n1.png,0.5,0,2\n2.png,0.6,0,0.1\n3.png,9,0,0\n")
    assert neighbours_by_pose(files, read_poses(csv)).tolist() == [[0, 2]]
    vectors = F.normalize(torch.tensor([[1.0, 0.0], [0.9, 0.1], [0.0, 1.0], [-1.0, 0.1]]), dim=1)
    assert alike(neighbours(files), vectors, most=1).tolist() == [[0, 1]]
    with pytest.raises(ModelError, match="within 1 m"):
        neighbours_by_pose(files[2:], read_poses(csv))

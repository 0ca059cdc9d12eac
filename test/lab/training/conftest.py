"""A tiny training world: smooth random pictures, so that one place differs from another and views of it agree."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pnv_core.describe.trunks.lite import lite_trunk


@pytest.fixture(scope="session")
def picture_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training folder of two walks of six pictures."""
    folder = tmp_path_factory.mktemp("training") / "walks"
    (folder / "images").mkdir(parents=True)
    rng = np.random.default_rng(5)
    rows = ["image,place_or_sequence_id,index_in_sequence,note"]
    for walk in ("a", "b"):
        for index in range(6):
            coarse = rng.integers(0, 256, (12, 16, 3), dtype=np.uint8)
            cv2.imwrite(str(folder / "images" / f"{walk}{index}.png"), cv2.resize(coarse, (128, 96)))
            rows.append(f"{walk}{index}.png,{walk},{index},")
    (folder / "groups.csv").write_text("\n".join(rows) + "\n")
    return folder


@pytest.fixture(scope="session")
def imagenet_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights with the names of the ImageNet file, values at random, batch norms included."""
    torch.manual_seed(3)
    path = tmp_path_factory.mktemp("weights") / "trunk.pth"
    layers = lite_trunk(1, neck=0, deep=True)
    convs = {n.removesuffix(".weight"): s for n, s in layers.tensor_shapes().items() if n.endswith(".weight")}
    norms = {"expand": "_bn0", "depthwise": "_bn1", "project": "_bn2"}
    published = {"stem": ("_conv_stem", "_bn0"), "head": ("_conv_head", "_bn1")}
    published["expand"] = ("_blocks.15._expand_conv", "_blocks.15._bn0")
    tensors: dict[str, torch.Tensor] = {}
    for name, (outputs, inputs, kernel, _) in convs.items():
        if name in published:
            conv, norm = published[name]
        else:
            _, block, part = name.split(".")
            conv, norm = f"_blocks.{block}._{part}_conv", f"_blocks.{block}.{norms[part]}"
        tensors[f"{conv}.weight"] = torch.randn(outputs, inputs, kernel, kernel) / (inputs * kernel**2) ** 0.5
        tensors |= {f"{norm}.{n}": torch.rand(outputs) + 0.5 for n in ("weight", "running_var")}
        tensors |= {f"{norm}.{n}": torch.randn(outputs) * 0.1 for n in ("bias", "running_mean")}
    torch.save(tensors, path)
    return path

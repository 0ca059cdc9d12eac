"""A tiny training world: smooth random pictures, so that one place differs from another and views of it agree."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pnv_core.describe.torch_model import TorchTrunk
from pnv_core.describe.trunks.compact import compact_trunk


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
    """Weights with the names of the ImageNet file, values at random."""
    torch.manual_seed(3)
    path = tmp_path_factory.mktemp("weights") / "trunk.pth"
    torch.save(TorchTrunk(compact_trunk(fires=8, neck=0)).state_dict(), path)
    return path

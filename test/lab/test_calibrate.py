"""`pnv calibrate` as a user meets it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from pnv_cli.main import main
from pnv_core.decide.calibration import Calibration, Logistic
from pnv_core.describe.model_files import load_model, save_model
from test.core.small import small_model
from test.verify.test_local_features import scene

QUICK = ["--fps", "1", "--min-interval-s", "0", "--min-change", "0", "--candidates", "4", "--threads", "1"]


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "small.safetensors"
    save_model(small_model(), path)
    return path


@pytest.fixture(scope="module")
def way(tmp_path_factory):
    """40 views along four panoramas, a second and 30 pixels apart."""
    folder = tmp_path_factory.mktemp("way")
    for part in range(4):
        panorama = scene(part, (160, 600))
        for i in range(10):
            view = np.ascontiguousarray(panorama[:, 30 * i : 30 * i + 192])
            Image.fromarray(cv2.resize(view, (192, 160))).save(folder / f"{part * 10 + i:03d}.png")
    return folder


def test_a_sequence_without_labels_calibrates_a_model(model, way, tmp_path, capsys):
    out = tmp_path / "mine.safetensors"
    flags = ["--near-s", "2", "--far-s", "12", "--weights", str(model), "-o", str(out), *QUICK]
    assert main(["calibrate", "--images", str(way), *flags]) == 0
    told = capsys.readouterr().out
    assert "expected calibration error" in told
    assert "precision 0.99" in told
    fitted = load_model(out)
    assert fitted.fingerprint() == load_model(model).fingerprint()
    assert Calibration.from_json(fitted.info.calibration).patch_sizes == (2, 5)


def test_what_the_closer_look_is_worth_stays_as_the_model_has_it(model, way, tmp_path):
    """A few candidates in doubt would fit anything. Under settings that the model's calibration is not for, it goes."""
    first, second, other = (tmp_path / f"{n}.safetensors" for n in range(3))
    flags = ["calibrate", "--images", str(way), "--near-s", "2", "--far-s", "12", *QUICK]
    assert main([*flags, "--weights", str(model), "-o", str(first)]) == 0
    fitted = load_model(first)
    before = Calibration.from_json(fitted.info.calibration)
    assert before.matched is None
    closer = replace(before, matched=Logistic(-1.0, {"concord": 2.0}))
    save_model(fitted.with_info(calibration=closer.to_json()), first)
    assert main([*flags, "--weights", str(first), "-o", str(second)]) == 0
    assert Calibration.from_json(load_model(second).info.calibration).matched == closer.matched
    assert main([*flags, "--weights", str(first), "--patch-sizes", "2", "-o", str(other)]) == 0
    assert Calibration.from_json(load_model(other).info.calibration).matched is None


def test_matches_and_poses_serve_as_truth(model, way, tmp_path):
    matches, poses = tmp_path / "m.csv", tmp_path / "p.csv"
    rows = [(f"{q:03d}.png", ";".join(f"{m:03d}.png" for m in range(max(0, q - 2), q))) for q in range(1, 40)]
    matches.write_text("query,true_refs\n" + "".join(f"{q},{m}\n" for q, m in rows))
    poses.write_text("frame,x,y\n" + "".join(f"{i:03d}.png,{i + 100 * (i // 10)},0\n" for i in range(40)))
    out = tmp_path / "mine.safetensors"
    flags = ["--weights", str(model), "-o", str(out), "--exclude-recent-s", "0", *QUICK]
    assert main(["calibrate", "--images", str(way), "--matches", str(matches), *flags]) == 0
    assert main(["calibrate", "--images", str(way), "--poses", str(poses), "--radius-m", "2", *flags]) == 0


def test_a_sequence_too_short_and_a_wrong_table_are_refused_in_one_line(model, way, tmp_path, capsys):
    out = tmp_path / "mine.safetensors"
    flags = ["--images", str(way), "--weights", str(model), "-o", str(out), *QUICK]
    assert main(["calibrate", *flags, "--near-s", "2", "--far-s", "1000"]) == 2
    assert "allowed: at least 30 of each" in capsys.readouterr().err
    table = tmp_path / "t.csv"
    table.write_text("image,place\n1,2\n")
    assert main(["calibrate", *flags, "--poses", str(table)]) == 2
    assert "lacks the column x, y;" in capsys.readouterr().err
    assert not out.exists()

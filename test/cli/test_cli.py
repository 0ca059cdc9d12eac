"""The command line as a user meets it: contracts of the outputs, and one clear line for every bad input."""

import csv
import json
import shutil
import struct
import subprocess
import sys

import cv2
import numpy as np
import pytest
from PIL import Image

from pnv_cli.main import main
from pnv_cli.sources import video
from pnv_core.describe.model_files import save_model
from test.core.small import small_model


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "small.safetensors"
    save_model(small_model(), path)
    return str(path)


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """Twelve different pictures, then the first six again."""
    folder = tmp_path_factory.mktemp("images")
    rng = np.random.default_rng(0)
    places = [
        cv2.resize(rng.integers(0, 256, (10, 12, 3), dtype=np.uint8), (192, 160), interpolation=cv2.INTER_NEAREST)
        for _ in range(12)
    ]
    for i in range(18):
        Image.fromarray(places[i % 12]).save(folder / f"{i:03d}.png")
    return folder


def refused(capsys, *argv):
    """The one line on stderr of a command that ends with 2."""
    try:
        code = main([str(a) for a in argv])
    except SystemExit as stop:  # argparse
        code = stop.code
    lines = [line for line in capsys.readouterr().err.strip().splitlines() if not line.startswith("usage:")]
    assert code == 2
    assert "Traceback" not in "\n".join(lines)
    return lines[-1]


def test_describe_writes_the_arrays_of_the_contract(model, images, tmp_path, capsys):
    assert main(["describe", str(images / "000.png"), "-o", str(tmp_path / "d.npz"), "--weights", model]) == 0
    with np.load(tmp_path / "d.npz") as arrays:
        assert sorted(arrays.files) == ["global", "grid_2", "grid_5", "patches_2", "patches_5"]
        assert arrays["global"].shape == (32,)
        assert np.linalg.norm(arrays["global"]) == pytest.approx(1, abs=1e-5)
        for size in (2, 5):
            rows, cols = arrays[f"grid_{size}"]
            assert (rows, cols) == (10 - size + 1, 12 - size + 1)
            assert arrays[f"patches_{size}"].shape == (rows * cols, 32)
            assert arrays[f"patches_{size}"].dtype == np.float32
            assert np.allclose(np.linalg.norm(arrays[f"patches_{size}"], axis=1), 1, atol=1e-5)


def test_match_prints_json_and_draws_both_images(model, images, tmp_path, capsys):
    draw = tmp_path / "m.png"
    command = [
        "match",
        str(images / "000.png"),
        str(images / "012.png"),
        "--weights",
        model,
        "--json",
        "--draw",
        str(draw),
    ]
    assert main(command) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["score"] == pytest.approx(1.0)
    assert report["similarity"] == pytest.approx(1.0, abs=1e-5)
    assert [s["patch_size"] for s in report["sizes"]] == [2, 5]
    assert all(s["rapid"] == pytest.approx(1.0) and s["inliers"] == s["matches"] for s in report["sizes"])
    assert Image.open(draw).size[0] > 2 * 192


def run_rows(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_run_finds_the_second_visit_and_keeps_the_column_contract(model, images, tmp_path):
    out = tmp_path / "c.csv"
    flags = [
        "--weights",
        model,
        "--fps",
        "1",
        "--exclude-recent-s",
        "5",
        "--min-interval-s",
        "0",
        "--min-change",
        "0",
        "--consistency",
        "0",
    ]
    assert main(["run", "--images", str(images), "--csv", str(out), "--all", *flags]) == 0
    rows = run_rows(out)
    columns = "query match query_stamp match_stamp score similarity spatial inliers accepted reason".split()  # noqa: SIM905
    assert list(rows[0]) == columns
    best = {r["query"]: r for r in rows}
    for i in range(12, 18):
        row = best[f"{i:03d}.png"]
        assert row["match"] == f"{i - 12:03d}.png"
        assert (float(row["query_stamp"]), float(row["match_stamp"])) == (i, i - 12)
        assert float(row["spatial"]) == pytest.approx(1.0, abs=0.01)  # the same bytes; patches are stored as float16
    first = out.read_bytes()
    assert main(["run", "--images", str(images), "--csv", str(out), "--all", *flags]) == 0
    assert out.read_bytes() == first


def test_run_takes_stamps_from_a_csv_and_reads_videos(model, images, tmp_path):
    stamps = tmp_path / "t.csv"
    stamps.write_text("frame,timestamp\n" + "".join(f"{i:03d}.png,{1700000000 + i}.123456789\n" for i in range(18)))
    out = tmp_path / "c.csv"
    flags = [
        "--weights",
        model,
        "--exclude-recent-s",
        "5",
        "--min-interval-s",
        "0",
        "--min-change",
        "0",
        "--all",
        "--csv",
        str(out),
    ]
    assert main(["run", "--images", str(images), "--timestamps", str(stamps), *flags]) == 0
    assert run_rows(out)[-1]["query_stamp"] == "1700000017.123456789"
    video = str(tmp_path / "v.avi")
    writer = cv2.VideoWriter(video, cv2.VideoWriter_fourcc(*"MJPG"), 1.0, (192, 160))
    for i in range(18):
        writer.write(cv2.imread(str(images / f"{i:03d}.png")))
    writer.release()
    assert main(["run", "--video", video, *flags]) == 0
    assert {(r["query"], r["match"]) for r in run_rows(out)} >= {("17", "5")}


def with_durations(path, parts):
    """Rewrites an mp4 of constant rate (ISO 14496-12, 8.6.1.2): (n, f) lets n frames stand f times as long."""
    data = bytearray(path.read_bytes())
    at = data.index(b"stts") - 4
    (size,), (ticks,) = struct.unpack_from(">I", data, at), struct.unpack_from(">I", data, at + 20)
    entries = b"".join(struct.pack(">II", count, factor * ticks) for count, factor in parts)
    data[at : at + size] = struct.pack(">I4sII", 16 + len(entries), b"stts", 0, len(parts)) + entries
    for box in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):  # whose sizes grew; the pixels lie before them
        start = data.index(box) - 4
        struct.pack_into(">I", data, start, struct.unpack_from(">I", data, start)[0] + 16 + len(entries) - size)
    at = data.index(b"edts")
    data[at : at + 4] = b"free"  # the edit list knows the old length
    path.write_bytes(data)


def test_frames_of_a_video_carry_their_own_times(tmp_path):
    """A camera that slows down in the dark gives a variable rate."""
    path = tmp_path / "v.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, (64, 48))
    for level in range(9):
        writer.write(np.full((48, 64, 3), 25 * level, np.uint8))
    writer.release()
    with_durations(path, [(3, 1), (3, 5), (3, 2)])
    stamps = [frame.stamp_ns / 1e9 for _, frame in video(str(path)).frames]
    assert stamps == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.8, 1.3, 1.8, 2.0, 2.2], abs=1e-3)


def test_every_unusable_image_gets_one_line_that_names_it(model, images, tmp_path, capsys):
    whole = (images / "000.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "empty.png").touch()
    (tmp_path / "text.png").write_text("hello")
    Image.new("1", (40000, 40000)).save(tmp_path / "huge.png")
    Image.new("1", (20000, 8000)).save(tmp_path / "wide.png")
    for name, words in {
        "missing.png": "no such image",
        "cut.png": "cannot be decoded",
        "empty.png": "is empty",
        "text.png": "is no image",
        "huge.png": "1600000000 pixels; allowed",
        "wide.png": "20000x8000 pixels; allowed",
    }.items():
        line = refused(capsys, "describe", tmp_path / name, "-o", tmp_path / "o.npz", "--weights", model)
        assert name in line
        assert words in line
    assert not (tmp_path / "o.npz").exists()
    assert "is a folder" in refused(capsys, "describe", tmp_path, "-o", tmp_path / "o.npz", "--weights", model)


@pytest.mark.parametrize("size", [(1, 1), (20000, 3), (3, 5000), (192, 160)])
def test_a_one_colour_image_of_any_size_is_described_and_closes_no_loop(model, size, tmp_path):
    folder = tmp_path / "blank"
    folder.mkdir()
    for i in range(3):
        Image.new("RGB", size, (90, 120, 60)).save(folder / f"{i}.png")
    flags = ["--fps", "0.01", "--min-change", "0", "--consistency", "0", "--weights", model]
    assert main(["run", "--images", str(folder), "--csv", str(tmp_path / "c.csv"), "--all", *flags]) == 0
    rows = run_rows(tmp_path / "c.csv")
    assert rows
    assert {r["reason"] for r in rows} == {"low_texture"}


@pytest.mark.parametrize("mode", ["L", "LA", "RGBA", "P", "I;16", "1", "CMYK"])
def test_images_of_every_colour_mode_are_read(mode, tmp_path):
    from pnv_core.images import read_image

    ramp = np.tile(np.arange(64, dtype=np.uint8) * 4, (48, 1))
    image = Image.fromarray(ramp.astype(np.uint16) * 256) if mode == "I;16" else Image.fromarray(ramp).convert(mode)
    image.save(tmp_path / ("x.tif" if mode == "CMYK" else "x.png"))
    rgb = read_image(tmp_path / ("x.tif" if mode == "CMYK" else "x.png"))
    assert (rgb.shape, rgb.dtype) == ((48, 64, 3), np.uint8)
    if mode not in ("1", "CMYK", "P"):
        assert np.abs(rgb[..., 0].astype(int) - ramp).max() <= 1


def test_an_unreadable_frame_is_skipped_by_name_and_the_others_are_kept(model, images, tmp_path, capsys):
    folder = tmp_path / "images"
    shutil.copytree(images, folder)
    (folder / "003.png").write_text("damaged")
    out = tmp_path / "c.csv"
    assert (
        main(
            [
                "run",
                "--images",
                str(folder),
                "--csv",
                str(out),
                "--weights",
                model,
                "--min-interval-s",
                "0",
                "--min-change",
                "0",
            ]
        )
        == 0
    )
    captured = capsys.readouterr()
    assert "skipped" in captured.err
    assert "003.png" in captured.err
    assert captured.out.startswith("17 frames, 17 keyframes")


def test_settings_outside_their_limits_are_named_with_what_is_allowed(images, tmp_path, capsys, model):
    def line(*flags):
        return refused(capsys, "run", "--images", images, "--csv", tmp_path / "c.csv", *flags)

    assert "candidates = 0 is out of range; allowed: whole number from 1 to 1000" in line("--candidates", "0")
    assert "candidates = 'many'" in line("--candidates", "many")
    assert "preset = 'best' is out of range; allowed: one of default, performance" in line("--preset", "best")
    assert "accept_score = nan" in line("--accept-score", "nan")
    assert "patch_weights = (0.5, 0.6) sum to 1.1" in line("--patch-sizes", "2,5", "--patch-weights", "0.5,0.6")
    assert "patch_sizes = (60,) exceed" in line("--patch-sizes", "60", "--weights", model)
    assert "unrecognized arguments: --candidate" in line("--candidate", "3")
    assert "no CUDA device" in line("--device", "cuda", "--weights", model)
    assert "fetch them with: pnv weights fetch mapillary_WPCA512" in line("--preset", "speed")
    assert "no such file; allowed: default" in line("--weights", "nowhere.safetensors")
    assert "--fps 0.0; allowed" in line("--fps", "0", "--weights", model)


def test_paths_that_cannot_be_written_or_read_are_refused_before_any_work(model, images, tmp_path, capsys):
    run = ["run", "--images", images, "--weights", model, "--csv"]
    assert "is a folder" in refused(capsys, *run, tmp_path)
    assert "does not exist" in refused(capsys, *run, tmp_path / "no" / "c.csv")
    assert "no such folder" in refused(capsys, "run", "--images", tmp_path / "no", "--csv", tmp_path / "c.csv")
    (tmp_path / "none").mkdir()
    assert "holds no image" in refused(capsys, "run", "--images", tmp_path / "none", "--csv", tmp_path / "c.csv")
    assert "no such video" in refused(capsys, "run", "--video", tmp_path / "v.mp4", "--csv", tmp_path / "c.csv")
    assert "cannot be read as a rosbag2" in refused(capsys, "run", "--bag", images, "--csv", tmp_path / "c.csv")
    stamps = tmp_path / "t.csv"
    rows = [f"{i:03d}.png,{i}.5" for i in range(18)]
    for row, message in {"004.png,3.5": "not later than", "004.png,soon": "line 6: timestamp 'soon'"}.items():
        stamps.write_text("\n".join(["frame,timestamp", *rows[:4], row, *rows[5:]]))
        assert message in refused(capsys, *run, tmp_path / "c.csv", "--timestamps", stamps)
    stamps.write_bytes(b"\xff\xfe\x00frame,timestamp")
    assert "is no csv text" in refused(capsys, *run, tmp_path / "c.csv", "--timestamps", stamps)
    pair = [images / "000.png", images / "001.png"]
    assert "is no picture; allowed: .png" in refused(capsys, "match", *pair, "--draw", tmp_path / "m.xyz")
    stamps.write_text("a,b\n1,2\n")
    assert "lacks the column frame, timestamp" in refused(capsys, *run, tmp_path / "c.csv", "--timestamps", stamps)


def test_a_wrong_model_file_is_refused_in_one_line(images, tmp_path, capsys):
    (tmp_path / "cut.pth.tar").write_bytes(b"PK\x03\x04 nothing")
    (tmp_path / "text.safetensors").write_text("hello")
    for name in ("cut.pth.tar", "text.safetensors"):
        line = refused(capsys, "match", images / "000.png", images / "001.png", "--weights", tmp_path / name)
        assert name in line
        assert refused(capsys, "weights", "verify", tmp_path / name)


def test_weights_list_names_the_six_published_files(capsys):
    assert main(["weights", "list"]) == 0
    out = capsys.readouterr().out
    for family in ("mapillary", "pittsburgh"):
        for dim in (128, 512, 4096):
            assert f"{family}_WPCA{dim}" in out


def test_weights_verify_takes_the_names_that_weights_list_prints(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert main(["weights", "verify", "default"]) == 0
    assert "default.safetensors: " in capsys.readouterr().out
    assert "pnv weights fetch mapillary_WPCA128" in refused(capsys, "weights", "verify", "mapillary_WPCA128")


def test_a_reader_that_has_seen_enough_is_told_nothing():
    """`pnv doctor | head -1`."""
    command = [sys.executable, "-c", "import sys; from pnv_cli.main import main; sys.exit(main(['doctor']))"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        child.stdout.close()
        said = child.stderr.read()
        assert child.wait(300) == 0
    assert said == b""

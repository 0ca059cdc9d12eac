"""`pnv run PATH`: one argument is enough; maps, exports and poses as a user meets them."""

import csv
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pnv_cli.main import COMMANDS, main
from pnv_core.describe.model_files import save_model
from test.core.small import small_model
from test.lab.evaluation.places import place, write

ROOT = Path(__file__).resolve().parents[2]
QUICK = ["--threads", "1", "--fps", "1", "--min-interval-s", "0", "--min-change", "0"]
SURE = [*QUICK, "--exclude-recent-s", "3", "--accept-score", "0", "--consistency", "0"]
WAY = [(0, 0), (5, 0), (5, 5), (3, 5), (0, 5), (0, 1), (5, 1)]  # metres; the last two frames see the first two again


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "small.safetensors"
    save_model(small_model(), path)
    return ["--weights", str(path)]


@pytest.fixture
def walk(tmp_path, monkeypatch):
    """A working folder with walk/images and three tables of the same poses."""
    monkeypatch.chdir(tmp_path)
    for i, seed in enumerate((0, 1, 2, 3, 4, 0, 1)):
        write(tmp_path / "walk" / "images" / f"{i}.png", place(seed, shift=3 * (i > 4)))
    named = "".join(f"{i}.png,{100 + i},{x},{y},0,0.5\n" for i, (x, y) in enumerate(WAY))
    (tmp_path / "named.csv").write_text("frame,timestamp,x,y,z,yaw\n" + named)
    turn = "0 0 0.247404 0.968912"  # 0.5 rad about z
    (tmp_path / "way.tum").write_text(
        "# a comment\n" + "".join(f"{i}.01 {x} {y} 0 {turn}\n" for i, (x, y) in enumerate(WAY))
    )
    head = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
    rows = "".join(f"{i}000000000,{x},{y},0,0.968912,0,0,0.247404\n" for i, (x, y) in enumerate(WAY))
    (tmp_path / "euroc.csv").write_text(head + rows)
    return tmp_path


def test_one_path_gives_a_table_a_report_and_counts_that_agree(walk, model, capsys):
    assert main(["run", "walk/images", *model, *SURE]) == 0
    told = capsys.readouterr().out
    (folder,) = (walk / "out").iterdir()
    assert re.fullmatch(r"walk-images-\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d", folder.name)
    rows = list(csv.DictReader((folder / "closures.csv").open()))
    counts = re.search(r"7 frames, 7 keyframes, (\d+) queries: (\d+) closed, by (\d+) pairs", told)
    assert counts is not None
    queries, closed, pairs = map(int, counts.groups())
    assert queries == 4  # frames 3 to 6 have candidates at least 3 s older
    assert pairs == len(rows)
    assert closed == len({row["query"] for row in rows})
    page = (folder / "report.html").read_text()
    assert counts.group(0) in page
    assert "pnv run walk/images --weights" in page


def test_an_empty_result_says_why(walk, model, capsys):
    assert main(["run", "walk/images", "--csv", "c.csv", *model, *QUICK]) == 0
    assert "7 frames span 6 s; a match must be at least 30 s older" in capsys.readouterr().out
    assert not (walk / "out").exists()
    assert main(["run", "walk/images", "--csv", "c.csv", *model, *SURE, "--accept-score", "1"]) == 0
    assert re.search(r"the best candidate scored [01]\.\d{3} and was refused as low_score", capsys.readouterr().out)


def test_a_recording_is_refused_before_any_work_where_its_library_is_missing(walk, model, capsys, monkeypatch):
    monkeypatch.setattr("pnv_cli.run.find_spec", lambda name: None)
    assert main(["run", "walk/images", "--rrd", "r.rrd", "--weights", "/nowhere.safetensors"]) == 2
    assert "pip install rerun-sdk" in capsys.readouterr().err  # and not that there is no such model


@pytest.mark.parametrize("poses", ["named.csv", "way.tum", "euroc.csv"])
def test_poses_of_every_layout_mean_the_same(walk, model, poses):
    command = ["run", "walk/images", "--out", "o", "--poses", poses, "--tum", "t.tum", "--pairs", "p.txt"]
    assert main([*command, *model, *SURE]) == 0
    assert "5.png ↔ 0.png, 1.0 m apart" in (walk / "o" / "report.html").read_text()
    written = np.loadtxt(walk / "t.tum")
    assert np.allclose(written[:, 0], range(7))
    assert np.allclose(written[:, 1:3], WAY)
    assert np.allclose(written[:, 4:], [0, 0, 0.247404, 0.968912], atol=1e-5)
    pairs = [line.split(" ") for line in (walk / "p.txt").read_text().splitlines()]
    rows = csv.DictReader((walk / "o" / "closures.csv").open())
    assert pairs == [[row["query"], row["match"]] for row in rows]


def test_closures_are_judged_by_the_poses(walk, model, capsys):
    command = ["run", "walk/images", "--out", "o", "--poses", "named.csv", "--radius-m", "2"]
    assert main([*command, *model, *SURE]) == 0
    told = capsys.readouterr().out
    pairs = [
        [int(row[side][0]) for side in ("query", "match")] for row in csv.DictReader((walk / "o/closures.csv").open())
    ]
    apart = [np.hypot(*np.subtract(WAY[query], WAY[match])) for query, match in pairs]
    right, wrong = sum(d <= 2 for d in apart), sum(d > 2 for d in apart)
    assert right > 0 < wrong
    words = f"{right} of {right + wrong} pairs with poses right, {wrong} wrong (right: at most 2 m apart"
    assert words in told
    page = (walk / "o" / "report.html").read_text()
    assert words in page
    for verdict, far in re.findall(r"<figcaption>(right|wrong), score [^<]* ([\d.]+) m apart<", page):
        assert (verdict == "right") == (float(far) <= 2)


def test_a_recording_is_read_by_the_program_that_shows_it(walk, model):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra rerun)")
    assert main(["run", "walk/images", "--rrd", "r.rrd", "--poses", "way.tum", *model, *SURE]) == 0
    assert not (walk / "out").exists()
    assert [path.name for path in walk.glob("*.rrd*")] == ["r.rrd"]
    for command in ("verify", "stats"):
        program = [Path(sys.executable).parent / "rerun", "rrd", command, "r.rrd"]
        told = subprocess.run(program, cwd=walk, capture_output=True, text=True, timeout=300)
        assert told.returncode == 0, told.stderr
    for entity in ("/image", "/match", "/path", "/path/closures", "/score/best", "/score/bar", "/similarity/best"):
        assert re.search(rf"^{entity}: \d+$", told.stdout, re.M), told.stdout


def test_poses_of_other_frames_and_without_orientation_are_refused(walk, model, capsys):
    (walk / "far.csv").write_text("timestamp,x,y\n1000,0,0\n")
    assert main(["run", "walk/images", "--out", "o", "--poses", "far.csv", *model, *SURE]) == 2
    assert "none of its 1 poses is within 0.1 s of a frame; the first frame is '0.png'" in capsys.readouterr().err
    assert main(["run", "walk/images", "--poses", "far.csv", "--tum", "t.tum", *model]) == 2
    assert "has no orientations" in capsys.readouterr().err


def test_a_pose_graph_has_a_node_for_every_keyframe(walk, model):
    assert main(["run", "walk/images", "--poses", "way.tum", "--g2o", "g.g2o", *model, *SURE]) == 0
    lines = (walk / "g.g2o").read_text().splitlines()
    assert sum(line.startswith("VERTEX_SE3:QUAT") for line in lines) == 7
    assert sum(line.startswith("EDGE_SE3:QUAT") for line in lines) == 6
    assert any(line.startswith("# closure 0 5 ") for line in lines)


def test_a_map_gives_what_its_run_gave_other_programs(walk, model, capsys):
    flags = ["--g2o", "g.g2o", "--tum", "t.tum", "--rtabmap", "r.graph", "--pairs", "p.txt", "--csv", "c.csv"]
    assert main(["run", "walk/images", "--poses", "way.tum", "--save-map", "m", *flags, *model, *SURE]) == 0
    for kind, path in (("g2o", "g.g2o"), ("tum", "t.tum"), ("rtabmap", "r.graph"), ("pairs", "p.txt")):
        beside = ["--poses", "way.tum", "--closures", "c.csv", "--kind", kind]
        assert main(["map", "export", "m", "-o", f"m.{kind}", *beside]) == 0
        ours, theirs = ((walk / name).read_text().splitlines() for name in (f"m.{kind}", path))
        assert [line.split(" score")[0] for line in ours] == [line.split(" score")[0] for line in theirs]
    lines = [line.split() for line in (walk / "r.graph").read_text().splitlines()]
    assert [len(words) for words in lines] == [8] * 7 + [30] * 6  # as RTAB-Map's reader counts them
    assert all(len(" ".join(words)) < 400 for words in lines)
    np.testing.assert_allclose([[float(v) for v in words[2:4]] for words in lines[:7]], WAY, atol=1e-5)
    assert lines[0][1] == "1"
    np.testing.assert_allclose(float(lines[0][7]), 0.5, atol=1e-4)  # yaw, of qz = 0.247404
    assert main(["map", "export", "m", "-o", "x", "--kind", "g2o"]) == 2
    assert "--kind g2o given; allowed: together with --poses FILE" in capsys.readouterr().err
    (walk / "bad.csv").write_text("query_stamp,match_stamp\n1,x\n")
    assert main(["map", "export", "m", "-o", "x", "--kind", "pairs", "--closures", "bad.csv"]) == 2
    assert "bad.csv: line 2" in capsys.readouterr().err


def test_a_map_of_monday_localises_the_run_of_tuesday(walk, model, capsys):
    assert main(["run", "walk/images", "--save-map", "m", "--csv", "c.csv", *model, *SURE]) == 0
    assert main(["run", "walk/images", "--load-map", "m", "--localize", "--out", "o", *model, *SURE]) == 0
    told = capsys.readouterr().out
    assert "m: 7 keyframes loaded" in told
    assert "7 frames, 0 keyframes, 7 queries: 7 closed" in told
    first = next(csv.DictReader((walk / "o" / "closures.csv").open()))
    assert (first["query"], first["match"]) == ("0.png", "map:0:0.000000000")
    assert (walk / "o" / "report.html").read_text().count("data:image/jpeg") >= 4  # pictures that the map keeps
    assert main(["run", "walk/images", "--csv", "c.csv", "--localize", *model]) == 2
    assert "together with --load-map" in capsys.readouterr().err


def test_a_settings_file_of_the_node_serves_the_command_line(walk, model, capsys):
    (walk / "s.yaml").write_text(
        "/**:\n  ros__parameters:\n    exclude_recent_s: 3.0\n    map_path: x\n    accept_score: 0.9\n"
    )
    asked = ["run", "walk/images", "--csv", "c.csv", "--config", "s.yaml", *model, *QUICK, "--accept-score", "0"]
    assert main([*asked, "--consistency", "0"]) == 0
    told = capsys.readouterr()
    assert " 4 queries: " in told.out  # frames 3 to 6 have candidates at least 3 s older
    assert "left out: map_path" in told.err
    (walk / "s.yaml").write_text("acept_score: 0.9\n")
    assert main(asked) == 2
    assert "acept_score is no setting; did you mean accept_score?" in capsys.readouterr().err
    (walk / "s.yaml").write_text("accept_score: 9\n")
    assert main(asked) == 2
    assert "accept_score = 9.0 is out of range" in capsys.readouterr().err


def test_match_says_the_verdict_first(walk, model, capsys):
    same, other = ["walk/images/0.png", "walk/images/0.png"], ["walk/images/0.png", "walk/images/3.png"]
    assert main(["match", *same, *model, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["probability"] > 0.5
    assert report["same_place"] is True
    assert main(["match", *other, *model]) == 0
    assert capsys.readouterr().out.startswith("same place  no (low_score): probability 0.")


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        (["runn"], "run"),
        (["run", "x", "--exclude-recent", "3"], "--exclude-recent-s"),
        (["map", "info", "x", "--jsn"], "--json"),
    ],
)
def test_a_typo_is_answered_with_the_nearest_name(given, meant, capsys):
    try:
        code = main(given)
    except SystemExit as stop:
        code = stop.code
    (line,) = capsys.readouterr().err.splitlines()
    assert code == 2
    assert f"did you mean {meant}?" in line


def test_help_is_short_and_help_all_has_every_setting(capsys):
    for flag, shown in (("--help", False), ("--help-all", True)):
        with pytest.raises(SystemExit) as stop:
            main(["run", flag])
        assert stop.value.code == 0
        page = capsys.readouterr().out
        assert "--accept-score" in page
        assert "{default,performance,balanced,speed,storage}" in page
        assert ("--odometry-drift" in page) is shown
    with pytest.raises(SystemExit):
        main(["describe", "--help-all"])
    page = capsys.readouterr().out
    assert "--image-width" in page
    assert "--accept-score" not in page


def test_no_help_waits_for_heavy_libraries():
    program = (
        "import sys\nfrom pnv_cli.main import COMMANDS, command_parser\n"
        "for name in COMMANDS: command_parser(name).format_help()\n"
        "print([m for m in ('torch', 'cv2', 'scipy', 'faiss', 'numba', 'PIL', 'rosbags') if m in sys.modules])"
    )
    told = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert told.stdout == "[]\n", told.stdout + told.stderr
    program = "import sys\nfrom pnv_cli.main import main\nmain(['--help'])\nprint('numpy' in sys.modules)"
    told = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert told.stdout.endswith("False\n")
    assert all(f"  {name} " in told.stdout for name in COMMANDS)


def test_the_version_is_that_of_the_package(capsys):
    stated = re.search(r"<version>(.*)</version>", (ROOT / "package.xml").read_text())
    assert stated is not None
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"pnv {stated.group(1)}\n"
    assert f'version="{stated.group(1)}"' in (ROOT / "setup.py").read_text()


@pytest.mark.parametrize("desc", ["frames", "frames: "])
def test_progress_off_a_terminal_is_lines_without_carriage_returns(desc, capsys, monkeypatch):
    from pnv_cli import progress

    monkeypatch.setattr(progress, "_EVERY_S", 0.0)
    assert list(progress.bar(range(3), desc=desc, unit="frame")) == [0, 1, 2]
    told = capsys.readouterr().err
    assert "\r" not in told
    assert re.search(r"frames: \d of 3 frames in 00:00\n", told)

"""`pnv fleet` on a served store: a map goes up and a selection comes down as the same map."""

import base64
import subprocess
import sys

import numpy as np

from pnv_cli.main import main
from pnv_core.database import KeyframeDatabase
from pnv_core.describe.describer import load_describer
from pnv_core.maps import MapStore
from pnv_core.recognizer import PlaceRecognizer
from pnv_core.types import Frame
from pnv_fleet.places import Place, encode_view, layouts_of, parts_of, to_row
from pnv_fleet.store import Access, PlaceStore
from test.ros.camera import scene

SECOND = 10**9


def test_a_map_goes_up_is_queried_comes_down_and_is_forgotten(server, tmp_path, capsys):
    import cv2

    places_of(server, ())  # none
    describer = load_describer("default", min_interval_s=0.0, min_change=0.0)
    robot = PlaceRecognizer(describer)
    for number in range(6):
        robot.process(Frame((1_700_000_000 + number) * SECOND, "front", scene(number)))
    MapStore(tmp_path / "up.map", describer.map_fingerprint).save(robot.database.snapshot())
    uri = ["--uri", server.uri]
    assert main(["fleet", "push", str(tmp_path / "up.map"), "--robot", "alpha", *uri]) == 0
    assert main(["fleet", "push", str(tmp_path / "up.map"), "--robot", "alpha", *uri]) == 0  # again: the same places
    assert main(["fleet", "status", *uri]) == 0
    assert "6 places" in capsys.readouterr().out
    cv2.imwrite(str(tmp_path / "query.png"), scene(3)[..., ::-1])
    assert main(["fleet", "query", str(tmp_path / "query.png"), *uri]) == 0
    best = capsys.readouterr().out.splitlines()[1]
    assert "alpha" in best
    assert "1700000003.0" in best
    assert best.endswith("accepted")
    since = ["--since", "2023-11-14T22:13:22"]  # 1,700,000,002 s
    assert main(["fleet", "pull", *since, "-o", str(tmp_path / "down.map"), *uri]) == 0
    down = KeyframeDatabase.for_describer(describer)
    MapStore(tmp_path / "down.map", describer.map_fingerprint).load(down)
    assert [ref.stamp_ns // SECOND - 1_700_000_000 for ref in down.refs()] == [2, 3, 4, 5]
    np.testing.assert_allclose(down.vector(down.refs()[1].id), robot.database.vector(3), atol=1e-6)
    assert main(["fleet", "verify", *uri]) == 0
    assert main(["fleet", "forget", *uri]) == 2
    assert "allowed: --robot" in capsys.readouterr().err
    assert main(["fleet", "forget", *since, *uri]) == 0
    assert "forgot 4 places, 2 are left" in capsys.readouterr().out
    assert main(["fleet", "forget", "--session", str(1_700_000_001 * SECOND), *uri]) == 0  # no session began then
    assert main(["fleet", "forget", "--older-than", "100", *uri]) == 0
    assert capsys.readouterr().out.count("forgot") == 2
    assert main(["fleet", "status", *uri]) == 0
    assert ", 0 places" in capsys.readouterr().out
    other = ["--image-width", "320", "--image-height", "240"]
    assert main(["fleet", "push", str(tmp_path / "up.map"), "--robot", "alpha", *uri, *other]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "was made with model" in line


def places_of(server, robots):
    describer = load_describer("default")
    width, height = describer.image_size
    like = describer.describe(np.zeros((height, width, 3), np.uint8))
    store = PlaceStore(
        server.uri, describer.map_fingerprint, Access(), len(like.global_vector), parts_of(layouts_of(like))
    )
    store.forget('key != ""')
    vector = like.global_vector
    for robot in robots:
        store.put([
            Place(robot, SECOND, "front", n, (1 + n) * SECOND, 0.5, vector, encode_view(like), (-5.0, float(n), 0.0))
            for n in range(3)
        ])  # fmt: skip
    return store


def test_covered_places_are_forgotten_of_the_robot_that_is_named(server, capsys):
    store = places_of(server, ("alpha", "beta"))
    assert main(["fleet", "forget", "--robot", "alpha", "--covered", "0.95", "--uri", server.uri]) == 0
    assert "forgot 2 places, 4 are left" in capsys.readouterr().out
    assert sorted(p.robot for p in store.scan()) == ["alpha", "beta", "beta", "beta"]


def test_an_area_may_lie_on_either_side_of_the_origin(server, capsys):
    places_of(server, ("alpha",))
    assert main(["fleet", "forget", "--area", "-5", "0", "1.5", "--uri", server.uri]) == 0
    assert "forgot 2 places, 1 are left" in capsys.readouterr().out


def test_status_names_the_sessions_that_forget_takes(server, capsys):
    places_of(server, ("alpha",))
    assert main(["fleet", "status", "--uri", server.uri]) == 0
    assert str(SECOND) in capsys.readouterr().out.split("\n", 2)[2]


def test_numbers_that_select_nothing_sensible_are_one_line(server, capsys):
    places_of(server, ("alpha",))
    for flags in (
        ["--older-than", "nan"], ["--older-than", "inf"], ["--older-than", "-1"], ["--covered", "nan"],
        ["--covered", "2"], ["--area", "nan", "0", "1"], ["--area", "0", "0", "-1"], ["--session", "-1"],
        ["--since", "0001-01-01T00:00+14:00"], ["--robot", 'a" or key != "'],
    ):  # fmt: skip
        assert main(["fleet", "forget", *flags, "--uri", server.uri]) == 2, flags
        (line,) = capsys.readouterr().err.splitlines()
        assert "allowed" in line, line
    assert main(["fleet", "status", "--uri", server.uri]) == 0
    assert ", 3 places" in capsys.readouterr().out


def test_rows_that_are_not_believed_do_not_stop_a_map_from_coming_down(server, tmp_path, capsys):
    store = places_of(server, ("alpha",))
    row = to_row(next(p for p in store.scan(views=True) if not isinstance(p, str)), store.parts)
    lie = base64.b64encode(b"PNVV" + bytes(30_000)).decode()
    store._client.upsert(store.collection, [row | {"key": "a" * 32, "robot": "no\nname"}])
    store._client.upsert(store.collection, [row | {"key": "b" * 32, "robot": "liar", "view_0": lie}])
    assert main(["fleet", "pull", "-o", str(tmp_path / "down.map"), "--uri", server.uri]) == 0
    *refused, last = capsys.readouterr().out.splitlines()
    assert last.endswith("3 keyframes in 1 sessions")
    assert len(refused) == 2
    assert all(line.startswith("refused ") for line in refused)
    assert main(["fleet", "pull", "--robot", "liar", "-o", str(tmp_path / "none.map"), "--uri", server.uri]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "allowed" in line
    places_of(server, ())


def test_a_store_that_speaks_no_tls_is_one_line(server):
    command = [sys.executable, "-m", "pnv_cli.main", "fleet", "status", "--uri", server.uri.replace("http:", "https:")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == f"pnv: {command[-1]}: the store cannot be reached\n"


def test_no_store_and_a_store_that_is_not_there_are_one_line(tmp_path, capsys):
    assert main(["fleet", "status", "--uri", ""]) == 2
    assert main(["fleet", "status", "--uri", str(tmp_path / "none.db")]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert "does not exist" in lines[1]

"""Numbers and names on the command line that are none: one line on stderr, status 2, nothing written."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pnv_cli.main import main
from test.maps.worlds import saved
from test.tally import count, tally

NUMBERS = st.one_of(st.floats().map(repr), st.integers().map(str), st.sampled_from(["nan", "inf", "-inf", "1e400",
                    "9" * 30, "9" * 5000, "0x10", ""]))  # fmt: skip
NAMES = st.one_of(st.sampled_from(["a\0b", "x" * 5000, "a\nb", "/" + "y/" * 3000, "\ud800", "/dev/full/x"]),
                  st.text(min_size=1, max_size=300).filter(lambda t: not t.startswith("-")))  # fmt: skip
tried = 0


@settings(max_examples=count(60, 3000), deadline=None, database=None, suppress_health_check=list(HealthCheck))
@given(number=NUMBERS, name=NAMES, which=st.integers(0, 4))
def test_no_value_gives_a_traceback(number, name, which, tmp_path_factory, capsys):
    global tried
    folder = tmp_path_factory.mktemp("h")
    saved(folder / "map", 3)
    line = [
        ["map", "prune", str(folder / "map"), "-o", str(folder / "out"), f"--budget-mb={number}"],
        ["map", "prune", str(folder / "map"), "-o", str(folder / "out"), f"--keep={number}"],
        ["map", "info", "./" + name],
        ["map", "export", str(folder / "map"), "-o", str(folder / "missing") + "/" + name + ".csv"],
        ["weights", "verify", "./" + name],
    ][which]
    capsys.readouterr()
    try:
        status = main(line)
    except SystemExit as ended:
        status = ended.code
    tried += 1
    said = capsys.readouterr().err
    assert status in (0, 2)
    if status == 2:
        assert len(said.encode("utf-8", "replace")) < 6000
        assert "Traceback" not in said


def test_a_stamp_outside_of_64_bits_is_refused(tmp_path, capsys):
    import cv2
    import numpy as np

    for number, stamp in enumerate(["9" * 30, "9223372037", "nan", "-9223372037"]):
        folder = tmp_path / str(number)
        folder.mkdir()
        cv2.imwrite(str(folder / "a.png"), np.zeros((64, 64, 3), np.uint8))
        (tmp_path / "t.csv").write_text(f"frame,timestamp\na.png,{stamp}\n")
        assert main(["run", str(folder), "--timestamps", str(tmp_path / "t.csv")]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    tally("10 values on the command line", tried + 4, tried + 4)


@pytest.mark.parametrize("value", ["nan", "inf", "9" * 400])
def test_a_number_that_is_not_finite_is_refused_whatever_the_flag(value, tmp_path, capsys):
    assert main(["map", "prune", str(tmp_path), "-o", str(tmp_path / "o"), f"--budget-mb={value}"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("name", ["~0", "~nobody of this name/x.safetensors"])
def test_the_home_of_a_user_that_is_not_there_is_one_line(name, capsys):
    assert main(["weights", "verify", name]) == 2
    assert capsys.readouterr().err.count("\n") == 1

"""`pnv doctor` names what is amiss; `pnv bench` proposes what the machine can keep up with."""

import json
import subprocess
from types import SimpleNamespace

import pytest

from pnv_cli import doctor
from pnv_cli.bench import Measured, proposals
from pnv_cli.main import main


@pytest.mark.process
def test_the_doctor_finds_this_machine_fit(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rclpy")
    assert main(["doctor", "--json"]) == 0
    findings = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(findings) == len(doctor.CHECKS)
    expected = {"openvino", "torch", "opencv", "faiss", "model", "ros", "middleware", "shared memory"}
    assert {f["check"] for f in findings} >= expected


def test_a_missing_rclpy_is_a_fault_with_advice(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    failed = SimpleNamespace(
        returncode=1, stdout="", stderr="Traceback\nModuleNotFoundError: No module named 'rclpy'\n"
    )
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: failed)
    assert main(["doctor"]) == 1
    out = capsys.readouterr().out
    assert "No module named 'rclpy'" in out
    assert "pip install 'pnv_ros[ros]'" in out


def test_little_shared_memory_is_a_fault_with_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _: SimpleNamespace(free=3e6, total=64e6))
    finding = doctor._shared_memory()
    assert finding.state == doctor.FAULT
    assert "--shm-size" in finding.advice


def test_a_check_that_breaks_is_reported_not_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> doctor.Finding:
        raise RuntimeError("no luck")

    assert doctor._guarded(broken).state == doctor.FAULT
    assert "no luck" in doctor._guarded(broken).words


def measured(width: int, scorer: str, describe: float, candidate: float) -> Measured:
    return Measured(width, width * 3 // 4, scorer, describe, candidate, 100.0)


TABLE = [measured(320, "ransac", 100, 10), measured(320, "rapid", 100, 2), measured(160, "ransac", 30, 4)]


def test_the_proposal_fills_seventy_percent_of_the_time() -> None:
    # 1 Hz leaves 700 ms: 100 + 50 * 10 = 600 fits
    assert next(proposals(TABLE, 1.0)) == (TABLE[0], 50)
    # 2 Hz leaves 350 ms: 100 + 25 * 10 = 350 fits exactly
    assert next(proposals(TABLE, 2.0)) == (TABLE[0], 25)
    # 5 Hz leaves 140 ms: RANSAC needs 150 for five candidates, rapid 120 for ten
    assert next(proposals(TABLE, 5.0)) == (TABLE[1], 10)
    # 10 Hz leaves 70 ms: only the small image, 30 + 10 * 4
    assert next(proposals(TABLE, 10.0)) == (TABLE[2], 10)
    assert not list(proposals(TABLE, 100.0))


def test_bench_prints_a_table_and_settings(capsys: pytest.CaptureFixture[str]) -> None:
    given = [
        "--seconds",
        "0.05",
        "--rate",
        "0.1",
        "--image-width",
        "160",
        "--image-height",
        "112",
        "--patch-sizes",
        "2",
    ]
    assert main(["bench", *given, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert {m["scorer"] for m in report["measured"]} == {"usac", "rapid"}
    assert report["proposal"]["candidates"] == 50
    assert report["check"]["keeps_up"]
    for m in report["measured"]:  # local features and thumbnails are in it
        assert m["frame_ms"] > 0
        assert m["keyframe_kb"] > 10
    assert main(["bench", "--rate", "0"]) == 2
    assert "--rate 0 is out of range" in capsys.readouterr().err

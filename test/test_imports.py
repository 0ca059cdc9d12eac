"""Who imports whom is a contract of pyproject.toml, and it is kept."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LINT = [sys.executable, "-c", "from importlinter.cli import lint_imports_command; lint_imports_command()"]


def lint(folder: Path) -> subprocess.CompletedProcess:
    return subprocess.run([*LINT, "--no-cache"], cwd=folder, capture_output=True, text=True, timeout=120)


def test_every_import_follows_the_contract():
    told = lint(ROOT)
    assert told.returncode == 0, told.stdout[-4000:]
    assert "0 broken" in told.stdout


def test_an_arrow_the_wrong_way_is_found(tmp_path):
    for package in ("pnv_core", "pnv_lab", "pnv_fleet", "msg_adapters", "pnv_ros", "pnv_cli"):
        (tmp_path / package).symlink_to(ROOT / package)
    (tmp_path / "pnv_core").unlink()
    (tmp_path / "pnv_core").mkdir()
    for part in (ROOT / "pnv_core").iterdir():
        if part.name != "errors.py" and part.name != "__pycache__":
            (tmp_path / "pnv_core" / part.name).symlink_to(part)
    (tmp_path / "pnv_core" / "errors.py").write_text(
        (ROOT / "pnv_core" / "errors.py").read_text() + "\nimport pnv_lab.fit\n"
    )
    (tmp_path / "pyproject.toml").write_text((ROOT / "pyproject.toml").read_text())
    told = lint(tmp_path)
    assert told.returncode != 0
    assert "the robot never imports the laboratory" in told.stdout

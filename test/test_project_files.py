"""The files around the code are valid by their own linters, and say what the code says."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pnv_core.config import Config
from pnv_core.settings import settings_of
from pnv_ros.node_config import NodeConfig

ROOT = Path(__file__).resolve().parents[1]
BIN = Path(sys.executable).parent


def said(*command: str) -> subprocess.CompletedProcess:
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize(
    ("schema", "file"),
    [
        ("vendor.github-workflows", ".github/workflows/ci.yml"),
        ("custom.github-workflows-require-timeout", ".github/workflows/ci.yml"),
        ("vendor.citation-file-format", "CITATION.cff"),
    ],
)
def test_a_file_follows_the_schema_of_those_who_read_it(schema, file):
    checker = shutil.which("check-jsonschema", path=str(BIN))
    if checker is None:
        pytest.skip("check-jsonschema is not installed (extra dev)")
    told = said(checker, "--builtin-schema", schema, file)
    assert told.returncode == 0, told.stdout + told.stderr


def test_the_dockerfile_passes_its_linter():
    linter = shutil.which("hadolint", path=str(BIN))
    if linter is None:
        pytest.skip("hadolint is not installed (extra dev)")
    told = said(linter, "Dockerfile")
    assert told.returncode == 0, told.stdout


def test_the_documentation_builds_strictly(tmp_path):
    pytest.importorskip("material", reason="mkdocs-material is not installed (extra docs)")
    told = said(sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site"))
    assert told.returncode == 0, told.stdout + told.stderr
    assert (tmp_path / "site" / "settings" / "index.html").is_file()


def test_requirements_are_those_of_the_package():
    required = re.search(r"REQUIRED = \[\n(.*?)\n\]", (ROOT / "setup.py").read_text(), re.S)
    assert required is not None
    lines = (ROOT / "requirements.txt").read_text().splitlines()
    assert [line for line in lines if not line.startswith("#")] == re.findall(
        r'^    "([^"]+)"', required.group(1), re.M
    )


def test_every_setting_of_the_settings_page_exists():
    page = (ROOT / "docs" / "settings.md").read_text()
    named = {name for row in re.findall(r"^\|[^|]*\|([^|]*)\|", page, re.M) for name in re.findall(r"`(\w+)`", row)}
    assert len(named) > 12
    assert named <= {*settings_of(Config), *settings_of(NodeConfig)}


# As rosdistro has them: rosdep/python.yaml at 000730dc, each with a rule for Ubuntu, and jazzy/distribution.yaml at
# 0006cdad, where rcl_interfaces, common_interfaces, geometry2, rclpy and launch_ros release them.
ROSDEP_KEYS = {
    "python3-matplotlib", "python3-numpy", "python3-opencv", "python3-pytest", "python3-scipy", "python3-tqdm",
    "python3-yaml",
    "builtin_interfaces", "lifecycle_msgs", "rcl_interfaces",
    "diagnostic_msgs", "geometry_msgs", "nav_msgs", "sensor_msgs", "std_msgs", "std_srvs", "visualization_msgs",
    "tf2_msgs", "rclpy", "ros2launch",
}  # fmt: skip


def test_rosdep_knows_every_dependency():
    named = re.findall(r"<(?:\w+_)?depend>(.*?)</", (ROOT / "package.xml").read_text())
    assert len(named) > 15
    assert set(named) <= ROSDEP_KEYS


def test_one_version_everywhere():
    versions = {
        re.search(pattern, (ROOT / file).read_text()).group(1)  # type: ignore[union-attr]
        for file, pattern in {
            "setup.py": r'version="([^"]+)"',
            "package.xml": r"<version>(.*)</version>",
            "CITATION.cff": r"^version: (.*)$",
            "QUALITY_DECLARATION.md": r"\| Version \| ([\d.]+);",
        }.items()
        for pattern in [f"(?m){pattern}"]
    }
    assert len(versions) == 1

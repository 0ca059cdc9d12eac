"""A ROS workspace builds both packages of this repository with the one command that docs/backends.md gives."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ENVIRONMENT = Path(sys.prefix)
MESSAGES = (
    "import pnv_msgs.msg as m, pnv_msgs.srv as s; m.LoopClosureArray(closures=[m.LoopClosure()]); print(m.__file__)"
)


def colcon(*arguments: str) -> subprocess.CompletedProcess:
    search = {"AMENT_PREFIX_PATH": str(ENVIRONMENT), "CMAKE_PREFIX_PATH": str(ENVIRONMENT)}
    path = f"{ENVIRONMENT / 'bin'}{os.pathsep}{os.environ['PATH']}"
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | search | {"PATH": path}
    return subprocess.run(
        [str(ENVIRONMENT / "bin" / "colcon"), *arguments], cwd=ROOT, env=environment, capture_output=True, text=True
    )


@pytest.fixture(scope="module", autouse=True)
def _tools() -> None:
    for tool, where in (("colcon", str(ENVIRONMENT / "bin")), ("cmake", None), ("c++", None), ("make", None)):
        if shutil.which(tool, path=where) is None:
            pytest.skip(f"no {tool}: a workspace cannot be built")
    if find_spec("rosidl_cmake") is None and not (ENVIRONMENT / "share" / "rosidl_cmake").is_dir():
        pytest.skip("no rosidl_cmake (extra interfaces): pnv_msgs cannot be built")


def test_one_command_builds_both_packages_and_the_documented_one_is_it(tmp_path):
    page = (ROOT / "docs" / "backends.md").read_text()
    written = re.search(r"it is `--base-paths ([^`]+)`", page)
    assert written is not None
    bases = written.group(1).split()
    done = colcon(
        "--log-base", str(tmp_path / "log"), "build", "--base-paths", *bases, "--build-base", str(tmp_path / "build"),
        "--install-base", str(tmp_path / "install"), "--cmake-args", f"-DPython3_EXECUTABLE={sys.executable}",
        f"-DPython3_ROOT_DIR={ENVIRONMENT}", "-DBUILD_TESTING=OFF",
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 packages finished" in done.stdout + done.stderr
    executables = {path.name for path in (tmp_path / "install" / "pnv_ros" / "lib" / "pnv_ros").iterdir()}
    assert {"place_recognizer", "tf_bridge", "rtabmap_bridge", "hydra_bridge", "swarm_slam_bridge"} <= executables

    messages = tmp_path / "install" / "pnv_msgs"
    library = Path(sysconfig.get_path("purelib")).relative_to(ENVIRONMENT)
    environment = os.environ | {"PYTHONPATH": str(messages / library), "LD_LIBRARY_PATH": str(messages / "lib")}
    told = subprocess.run([sys.executable, "-c", MESSAGES], env=environment, capture_output=True, text=True)
    assert told.returncode == 0, told.stderr
    assert Path(told.stdout.strip()).is_relative_to(messages)


def test_colcon_alone_stops_at_the_package_in_the_root():
    """The reason why the nested package has to be named; where colcon learns to descend the page may be simpler."""
    listed = colcon("--log-base", "/dev/null", "list", "--names-only", "--base-paths", ".")
    assert listed.stdout.split() == ["pnv_ros"]

"""Builds interface packages (messages, services) into the environment of the Jazzy wheels, without ROS installed.

    python .ci/build_interfaces.py PACKAGE_FOLDER ... [--prefix FOLDER]

The wheels' CMake files name the include folders of the machine they were built on, of Python and of numpy; they are
mended first, which is done once per environment (`--mend` does only that). What is built into the environment's own
folder is importable at once; into another folder, it needs its lib on LD_LIBRARY_PATH and its packages on PYTHONPATH.
Ends with 0 and one line where there is no compiler: pnv_msgs is optional.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

ENVIRONMENT = Path(sys.prefix)
TOOLS = ("cmake", "c++", "make")


def mend() -> int:
    """Point the wheels' CMake files to this machine's headers; how many were changed."""
    import numpy

    changed = 0
    for path in ENVIRONMENT.glob("share/*/cmake/*.cmake"):
        text = path.read_text()
        mended = re.sub(r"/[^;\"\s]*/include/python3\.\d+(?=[;\"])", sysconfig.get_path("include"), text)
        mended = re.sub(r"/[^;\"\s]*/numpy/_?core/include(?=[;\"])", numpy.get_include(), mended)
        if mended != text:
            path.write_text(mended)
            changed += 1
    return changed


def build(package: Path, prefix: Path) -> None:
    """Configure, build and install one package. Raises CalledProcessError with its output."""
    search = os.pathsep.join(dict.fromkeys(map(str, (prefix, ENVIRONMENT))))
    environment = os.environ | {
        "AMENT_PREFIX_PATH": search,
        "CMAKE_PREFIX_PATH": search,
        "PATH": f"{ENVIRONMENT / 'bin'}{os.pathsep}{os.environ['PATH']}",
    }
    environment.pop("PYTHONPATH", None)
    with tempfile.TemporaryDirectory() as work:
        for command in (
            ["cmake", "-S", str(package.resolve()), "-B", work, "-Wno-dev", f"-DCMAKE_INSTALL_PREFIX={prefix}",
             f"-DPython3_EXECUTABLE={sys.executable}", f"-DPython3_ROOT_DIR={ENVIRONMENT}", "-DBUILD_TESTING=OFF",
             "-DCMAKE_INSTALL_RPATH=$ORIGIN;$ORIGIN/../../.."],
            ["cmake", "--build", work, "--parallel", str(os.cpu_count() or 1)],
            ["cmake", "--install", work],
        ):  # fmt: skip
            subprocess.run(
                command, env=environment, check=True, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
            )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("packages", type=Path, nargs="*", metavar="PACKAGE_FOLDER")
    parser.add_argument("--prefix", type=Path, default=ENVIRONMENT, help="default: this environment")
    parser.add_argument("--mend", action="store_true", help="only mend the CMake files")
    args = parser.parse_args()
    mend()
    if args.mend:
        return 0
    missing = [tool for tool in TOOLS if shutil.which(tool) is None]
    names = ", ".join(package.name for package in args.packages)
    if missing:
        print(f"{names} not built, ~/closures stays off: no {', '.join(missing)}; on Debian: "
              "apt-get install g++ make cmake")  # fmt: skip
        return 0
    args.prefix.mkdir(parents=True, exist_ok=True)
    for package in args.packages:
        try:
            build(package, args.prefix.resolve())
        except subprocess.CalledProcessError as error:
            print(error.output[-4000:], file=sys.stderr)
            print(f"{package} could not be built: {' '.join(error.cmd[:2])} failed", file=sys.stderr)
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

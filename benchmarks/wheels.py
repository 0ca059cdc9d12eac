"""Which wheels of its dependencies an aarch64 machine (Raspberry Pi 5, Jetson) would get, by name and version.

    python -m benchmarks.wheels [--python 3.12] [REQUIREMENT ...]

Those of requirements.txt, or the ones named. Asks the package index as pip does and installs nothing: a wheel that is
listed was found, not tried.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

_PLATFORMS = [f"manylinux_2_{minor}_aarch64" for minor in (39, 35, 34, 31, 28, 27, 26, 17)] + ["manylinux2014_aarch64"]


def wheel(requirement: str, python: str) -> str:
    """The file pip would take, or its complaint."""
    with tempfile.TemporaryDirectory() as target:
        command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--report", "-", "--target", target]
        command += ["--no-deps", "--only-binary", ":all:", "--implementation", "cp", "--python-version", python]
        for platform in _PLATFORMS:
            command += ["--platform", platform]
        done = subprocess.run([*command, requirement], capture_output=True, text=True)
    if done.returncode:
        return "none: " + ([line for line in done.stderr.splitlines() if "ERROR" in line] or ["?"])[-1][:90]
    return str(json.loads(done.stdout)["install"][0]["download_info"]["url"]).rpartition("/")[2]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("requirements", nargs="*", metavar="REQUIREMENT")
    parser.add_argument("--python", default="3.12", help="of ROS 2 Jazzy on Ubuntu 24.04")
    args = parser.parse_args()
    listed = Path("requirements.txt").read_text().splitlines()
    print("| requirement | wheel for aarch64 |\n|---|---|")
    for requirement in args.requirements or [line for line in listed if line and not line.startswith("#")]:
        print(f"| {requirement} | {wheel(requirement, args.python)} |", flush=True)


if __name__ == "__main__":
    main()

"""--poses: where each frame was taken, read the same way by every command.

A csv with columns x,y and, if known, z, yaw (radians about z) or qx,qy,qz,qw; a TUM trajectory (timestamp tx ty tz qx
qy qz qw, seconds); or EuRoC's ground truth (timestamp [ns], position, quaternion as w x y z): the formats and
conventions of evo. A frame's pose is the row that names it in the column `frame`, where there is one; otherwise the one
nearest in time, at most 0.1 s away.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnv_core.errors import PnvError
from pnv_lab.evaluation.datasets.tables import number, numbers, rows, words

Floats = NDArray[np.float64]
Frame = tuple[str, int]  # name, stamp in ns
FAR_S = 0.1  # between a frame and its pose


@dataclass(frozen=True, eq=False)
class Poses:
    """N poses. `times` in seconds, ascending; `quaternions` (N, 4) as x, y, z, w; None: not known."""

    path: Path
    positions: Floats  # (N, 3) metres
    quaternions: Floats | None
    times: Floats
    row_of: dict[str, int] | None  # by frame name

    def row(self, name: str, stamp_ns: int) -> int | None:
        """The row of a frame, None where it has no pose."""
        if self.row_of is not None:
            return self.row_of.get(name)
        if not len(self.times):
            return None
        after = int(np.searchsorted(self.times, stamp_ns / 1e9))
        near = min(
            (max(after - 1, 0), min(after, len(self.times) - 1)), key=lambda i: abs(self.times[i] - stamp_ns / 1e9)
        )
        return near if abs(self.times[near] - stamp_ns / 1e9) <= FAR_S else None

    def turn_deg(self, a: int, b: int) -> float:
        """Angle between two poses in degrees; 0 where orientations are not known."""
        if self.quaternions is None:
            return 0.0
        return float(np.degrees(2 * np.arccos(min(1.0, abs(float(self.quaternions[a] @ self.quaternions[b]))))))

    def of_frames(self, frames: Iterable[Frame]) -> dict[Frame, int]:
        """Row by (name, stamp) of those with a pose. Raises PnvError where none has one."""
        asked = list(frames)
        found = {frame: row for frame in asked if (row := self.row(*frame)) is not None}
        if asked and not found:
            how = "names" if self.row_of is not None else f"is within {FAR_S} s of"
            raise PnvError(
                f"{self.path}: none of its {len(self.positions)} poses {how} a frame; the first frame is "
                f"{asked[0][0]!r} at {asked[0][1] / 1e9:.3f} s"
            )
        return found


class PoseTruth:
    """Whether two frames of a run, each a (name, stamp), show one place: near each other and turned alike."""

    def __init__(self, poses: Poses, frames: Iterable[Frame], radius_m: float, angle_deg: float) -> None:
        """Raises PnvError where no frame has a pose."""
        self.poses, self.rows = poses, poses.of_frames(frames)
        self._radius_m, self._angle_deg = radius_m, angle_deg
        self.rule = f"right: at most {radius_m:g} m apart and {angle_deg:g} degrees turned"

    def position(self, frame: Frame) -> Floats | None:
        """(3,) in metres."""
        row = self.rows.get(frame)
        return None if row is None else self.poses.positions[row]

    def apart_m(self, a: Frame, b: Frame) -> float | None:
        """Distance of two frames; None where a pose is not known."""
        ends = self.position(a), self.position(b)
        return None if ends[0] is None or ends[1] is None else float(np.linalg.norm(ends[0] - ends[1]))

    def right(self, a: Frame, b: Frame) -> bool | None:
        """None where a pose is not known."""
        apart = self.apart_m(a, b)
        if apart is None:
            return None
        return apart <= self._radius_m and self.poses.turn_deg(self.rows[a], self.rows[b]) <= self._angle_deg

    def counted(self, pairs: Iterable[tuple[Frame, Frame]]) -> str:
        """How many pairs are right, in words."""
        verdicts = [self.right(*pair) for pair in pairs]
        known = sum(v is not None for v in verdicts)
        return f"{verdicts.count(True)} of {known} pairs with poses right, {verdicts.count(False)} wrong ({self.rule})"


def read_poses(path: Path | str) -> Poses:
    """The poses of a file, by its layout. Raises PnvError naming the file and what is wrong with it."""
    source = Path(path)
    first = _first_line(source)
    if first.startswith("#timestamp") and "p_RS_R_x" in first:
        return _euroc(source)
    if _numeric(first.split()):
        return _tum(source)
    return _csv(source)


def _first_line(path: Path) -> str:
    """The first line that is no plain comment."""
    try:
        with open(path, encoding="utf-8-sig") as file:
            lines = (line.strip() for line in file)
            return next((line for line in lines if line and not (line.startswith("#") and "," not in line)), "")
    except FileNotFoundError:
        raise PnvError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise PnvError(f"{path}: cannot be read ({error})") from None


def _numeric(texts: list[str]) -> bool:
    try:
        return bool([float(text) for text in texts])
    except ValueError:
        return False


def _tum(path: Path) -> Poses:
    table = np.array([numbers(path, line, texts, 8) for line, texts in words(path)])
    return _timed(path, table[:, 0], table[:, 1:4], table[:, 4:8])


def _euroc(path: Path) -> Poses:
    lines = [(n, texts[0].split(",")[:8]) for n, texts in words(path)]
    table = np.array([numbers(path, line, texts, 8) for line, texts in lines])
    return _timed(path, table[:, 0] / 1e9, table[:, 1:4], table[:, [5, 6, 7, 4]])


def _csv(path: Path) -> Poses:
    table = rows(path, ("x", "y"))
    names = set(table[0]) if table else set()
    if table and not names & {"frame", "timestamp"}:
        raise PnvError(f"{path}: lacks the column frame or timestamp; it has {', '.join(table[0])}")
    at = np.array([[number(path, row, axis) if axis in row else 0.0 for axis in "xyz"] for row in table]).reshape(-1, 3)
    quaternions = None
    if {"qx", "qy", "qz", "qw"} <= names:
        quaternions = np.array([[number(path, row, f"q{axis}") for axis in "xyzw"] for row in table])
    elif "yaw" in names:
        half = np.array([number(path, row, "yaw") for row in table]) / 2
        quaternions = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=1)
    if "frame" in names:
        row_of = {row["frame"].strip(): i for i, row in enumerate(table)}
        return Poses(path, at, _unit(path, quaternions), np.empty(0), row_of)
    times = np.array([number(path, row, "timestamp") for row in table])
    return _timed(path, times, at, quaternions)


def _timed(path: Path, times: Floats, positions: Floats, quaternions: Floats | None) -> Poses:
    order = np.argsort(times, kind="stable")
    unit = _unit(path, quaternions)
    return Poses(path, positions[order], None if unit is None else unit[order], times[order], None)


def _unit(path: Path, quaternions: Floats | None) -> Floats | None:
    if quaternions is None:
        return None
    length = np.linalg.norm(quaternions, axis=1, keepdims=True)
    if not (length > 0).all():
        raise PnvError(f"{path}: row {int(np.argmin(length[:, 0])) + 1} has a quaternion of length 0")
    return quaternions / length

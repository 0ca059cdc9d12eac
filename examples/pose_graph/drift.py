"""Odometry as a robot measures it: true motion with a wrong wheel size, a turning drift and noise."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Drift:
    """How bad the odometry is; by default as of wheels without a gyroscope. Signs are drawn, magnitudes vary by 0.3.

    scale: relative error of the way; deg_per_m: turning drift of the way; turn: relative error of the turns;
    slip_m: what each step slips sideways, as of a velocity that is measured with a bias; step: white noise of each
    step, relative to it.
    """

    scale: float = 0.02
    deg_per_m: float = 0.5
    turn: float = 0.0
    slip_m: float = 0.0
    step: float = 0.05


def drifted(truth: Array, drift: Drift, seed: int) -> Array:
    """(n, 4, 4) true poses -> (n, 4, 4) odometry that begins at the first true pose."""
    rng = np.random.default_rng((seed, 11))
    scale, deg_per_m, turn, slip_m = (
        rng.choice([-1, 1], 4) * rng.uniform(0.7, 1.0, 4) * (drift.scale, drift.deg_per_m, drift.turn, drift.slip_m)
    )
    steps = np.linalg.inv(truth[:-1]) @ truth[1:]
    ways = np.linalg.norm(steps[:, :3, 3], axis=1)
    turns = np.arctan2(steps[:, 1, 0], steps[:, 0, 0])
    errors = (
        turn * turns
        + np.deg2rad(deg_per_m) * ways
        + np.deg2rad(drift.deg_per_m) * ways * rng.standard_normal(len(ways))
    )
    odometry = [truth[0]]
    for step, error in zip(steps, errors, strict=True):
        measured = step.copy()
        measured[:3, 3] *= 1 + scale + drift.step * rng.standard_normal()
        measured[1, 3] += slip_m
        c, s = np.cos(error), np.sin(error)
        measured[:3, :3] = measured[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        odometry.append(odometry[-1] @ measured)
    return np.array(odometry)

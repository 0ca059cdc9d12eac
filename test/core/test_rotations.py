"""Rotations against scipy's, covariances against finite differences."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pnv_core.rotations import (
    angle_of,
    exponential,
    from_euler,
    inverse,
    inverted,
    local_covariance,
    logarithm,
    matrix_of,
    quaternion_of,
    rigid,
    transported,
)


def random_pose(rng):
    return rigid(Rotation.random(random_state=rng.integers(2**31)).as_matrix(), rng.normal(size=3))


def test_they_agree_with_scipy():
    turns = Rotation.random(200, random_state=1)
    assert np.allclose(matrix_of(turns.as_quat() * 3), turns.as_matrix())
    assert np.allclose(quaternion_of(turns.as_matrix()), turns.as_quat(canonical=True))
    assert np.allclose([exponential(v) for v in turns.as_rotvec()], turns.as_matrix())
    assert np.allclose([logarithm(m) for m in turns.as_matrix()], turns.as_rotvec())
    assert np.allclose(angle_of(turns.as_matrix()), turns.magnitude())
    assert np.allclose(from_euler(0.1, -0.4, 2.0), Rotation.from_euler("xyz", [0.1, -0.4, 2.0]).as_matrix())


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, np.pi - 1e-9, np.pi])
def test_no_angle_is_special(angle):
    vector = angle * np.array([2.0, -1.0, 2.0]) / 3
    assert np.allclose(np.abs(logarithm(exponential(vector))), np.abs(vector), rtol=1e-6, atol=1e-15)
    assert np.allclose(matrix_of(quaternion_of(exponential(vector))), exponential(vector))


def test_a_quaternion_without_length_is_no_rotation():
    assert np.isnan(matrix_of([[0, 0, 0, 0], [np.nan, 0, 0, 1]])).all()


def test_covariances_move_with_their_poses():
    rng, h = np.random.default_rng(0), 1e-6
    covariance = np.diag(rng.uniform(1, 2, 6))

    def moved(pose, step):
        return rigid(exponential(step[3:]) @ pose[:3, :3], pose[:3, 3] + step[:3])

    def away(a, b):
        return np.append(a[:3, 3] - b[:3, 3], logarithm(a[:3, :3] @ b[:3, :3].T))

    for _ in range(20):
        before, pose, after = (random_pose(rng) for _ in range(3))
        cases = {
            "transported": transported(covariance, pose, before, after),
            "inverted": inverted(covariance, pose),
            "local": local_covariance(covariance, pose),
        }
        for name, given in cases.items():
            columns = []
            for step in h * np.eye(6):
                changed = moved(pose, step)
                if name == "transported":
                    columns.append(away(before @ changed @ after, before @ pose @ after) / h)
                elif name == "inverted":
                    columns.append(away(inverse(changed), inverse(pose)) / h)
                else:
                    columns.append(away(inverse(pose) @ changed, np.eye(4)) / h)
            jacobian = np.column_stack(columns)
            assert np.allclose(given, jacobian @ covariance @ jacobian.T, atol=1e-4), name

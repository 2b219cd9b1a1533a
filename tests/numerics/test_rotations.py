"""Rotations: against SciPy, inverse of one another, and finite where angles are not determined."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from creps_jax.numerics.rotations import (
    matrix_to_rpy,
    quat_to_matrix,
    quat_to_rpy,
    rigid_transform,
    rotation_x,
    rotation_y,
    rotation_z,
    rpy_to_matrix,
    rpy_to_quat,
    safe_arctan2,
)

HALF_PI = np.pi / 2.0


def random_rpy(count=200):
    random = np.random.default_rng(0)
    return random.uniform([-np.pi, -HALF_PI, -np.pi], [np.pi, HALF_PI, np.pi], (count, 3)).astype(np.float32)


@pytest.mark.parametrize(("function", "axis"), [(rotation_x, "x"), (rotation_y, "y"), (rotation_z, "z")])
@pytest.mark.parametrize("angle", [0.7, -2, np.float32(0.1)])
def test_axis_rotations_agree_with_scipy(function, axis, angle):
    np.testing.assert_allclose(function(angle), Rotation.from_euler(axis, angle).as_matrix(), atol=1e-6)


def test_angles_have_the_documented_signs():
    up = np.array([0.0, 0.0, 1.0], np.float32)
    assert (rpy_to_matrix(jnp.array([0.0, 0.1, 0.0])) @ up)[0] > 0.0  # pitch leans forward
    assert (rpy_to_matrix(jnp.array([0.1, 0.0, 0.0])) @ up)[1] < 0.0  # roll leans to the right
    assert rpy_to_matrix(jnp.array([0.0, 0.0, 0.1]))[1, 0] > 0.0  # yaw turns to the left


def test_matrices_and_quaternions_agree_with_scipy():
    rpy = random_rpy()
    expected = Rotation.from_euler("xyz", rpy).as_matrix()  # about fixed axes: first x, last z
    np.testing.assert_allclose(jax.vmap(rpy_to_matrix)(rpy), expected, atol=1e-6)
    quaternions = jax.vmap(rpy_to_quat)(rpy)
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(jax.vmap(quat_to_matrix)(quaternions), expected, atol=1e-6)


def test_angles_come_back():
    rpy = random_rpy()
    inside = np.abs(rpy[:, 1]) < 1.5  # closer to the lock, roll and yaw alone lose their digits
    from_matrix = jax.vmap(lambda row: matrix_to_rpy(rpy_to_matrix(row)))(rpy[inside])
    from_quaternion = jax.vmap(lambda row: quat_to_rpy(rpy_to_quat(row)))(rpy[inside])
    np.testing.assert_allclose(from_matrix, rpy[inside], atol=1e-4)
    np.testing.assert_allclose(from_quaternion, rpy[inside], atol=1e-4)


@pytest.mark.parametrize("distance", [0.0, 1e-7, 1e-5, 1e-3, 1e-2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_matrix_comes_back_at_and_near_gimbal_lock(sign, distance):
    rpy = jnp.array([0.4, sign * (HALF_PI - distance), -1.1])
    rotation = rpy_to_matrix(rpy)
    angles = matrix_to_rpy(rotation)
    np.testing.assert_allclose(rpy_to_matrix(angles), rotation, atol=1e-5)
    assert np.isfinite(jax.jacobian(matrix_to_rpy)(rotation)).all()


def test_everything_is_finite_at_exact_lock():
    locked = jnp.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    np.testing.assert_allclose(matrix_to_rpy(locked), [0.0, HALF_PI, 0.0], atol=1e-6)
    assert np.isfinite(jax.jacobian(matrix_to_rpy)(locked)).all()


def test_quaternions_of_any_length_and_sign_turn_the_same():
    quaternion = rpy_to_quat(jnp.array([0.3, -0.2, 1.0]))
    expected = quat_to_matrix(quaternion)
    for scale in (-1.0, 0.01, 100.0):
        np.testing.assert_allclose(quat_to_matrix(scale * quaternion), expected, atol=1e-6)
    np.testing.assert_array_equal(quat_to_matrix(jnp.zeros(4)), np.eye(3))
    assert np.isfinite(jax.jacobian(quat_to_matrix)(jnp.zeros(4))).all()


def test_a_rigid_transform_turns_and_moves():
    rotation, position = rpy_to_matrix(jnp.array([0.3, -0.2, 1.0])), jnp.array([1.0, -2.0, 3.0])
    transform = rigid_transform(rotation, position)
    point = jnp.array([0.5, 0.1, -0.4])
    moved = transform @ jnp.append(point, 1.0)
    np.testing.assert_allclose(moved, jnp.append(rotation @ point + position, 1.0), atol=1e-6)


def test_safe_arctan2_equals_arctan2_but_for_the_origin():
    y, x = np.random.default_rng(1).normal(size=(2, 50)).astype(np.float32)
    np.testing.assert_allclose(safe_arctan2(jnp.asarray(y), jnp.asarray(x)), np.arctan2(y, x), atol=1e-6)
    gradients = jax.grad(safe_arctan2, argnums=(0, 1))(jnp.zeros(()), jnp.zeros(()))
    np.testing.assert_array_equal(gradients, (0.0, 0.0))


def test_rotations_are_float32():
    assert rpy_to_matrix(jnp.zeros(3)).dtype == jnp.float32

"""Forward and inverse kinematics of a leg that is given by its joint axes.

A pose is `T_torso_sole`, the sole in the frame of the trunk, as in `nao_kinematics`.
"""

import jax.numpy as jnp
from jax import lax

from creps_jax import checks
from creps_jax.numerics.rotations import rigid_transform
from creps_jax.robots.humanoid import LegChain
from creps_jax.typing import Array, Float, IntScalar

__all__ = ["chain_fk", "chain_ik"]

# Largest change of an angle in one iteration, rad.
LARGEST_STEP = 0.5
# Damping for each unit of squared pose error, and at the solution. It bounds the steps out of reach and at a
# straight leg; near a solution it vanishes, and the convergence is quadratic.
DAMPING, LEAST_DAMPING = 0.1, 1e-7
# Largest squared error that adds to the damping: with poses that float32 can hold no step is NaN.
LARGEST_ERROR = 1e9


@checks.arguments
def chain_fk(joint_pos: Float[Array, " k"], chain: LegChain) -> Float[Array, "4 4"]:
    """Return the pose of the sole in the torso frame, `T_torso_sole`.

    Args:
        joint_pos: Angles of the leg's joints from hip to ankle, rad.
        chain: Axes of the leg.

    Raises:
        ValueError: If there is not one finite angle for each axis.

    Source: Murray, Li and Sastry 1994, A mathematical introduction to robotic manipulation, Section 3.2, the
    product of exponentials.
    """
    checks.finite("joint_pos", checks.array("joint_pos", joint_pos, (len(chain.axes),)))
    rotation, position, _, _ = _sole_and_axes(joint_pos, chain)
    return rigid_transform(rotation, position)


@checks.arguments
def chain_ik(
    T_torso_sole: Float[Array, "4 4"], guess: Float[Array, " k"], chain: LegChain, *, iterations: int = 3
) -> Float[Array, " k"]:
    """Return joint angles for a pose of the sole in the torso frame, the inverse of `chain_fk`.

    Each iteration is a Newton step that is damped in proportion to the squared error of the pose. Joints that
    it would take beyond a limit stop there, and the others make up for them. Within the limits and the reach
    it converges quadratically: from angles within 0.05 rad, three iterations leave an error below 1e-5 m and
    rad. Out of reach the angles are finite and the sole is near the pose. All angles are within the limits.
    A leg of fewer than six joints approximates the pose by `chain.weights`.

    Args:
        T_torso_sole: Desired pose of the sole in the torso frame, m.
        guess: Angles from which to start, rad.
        chain: Axes of the leg.
        iterations: Number of Newton steps.

    Raises:
        ValueError: If the pose is not a finite matrix (4, 4), or there is not one finite angle for each axis.

    Source: Sugihara 2011, Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt method.
    """
    checks.finite("T_torso_sole", T_torso_sole)
    checks.finite("guess", checks.array("guess", guess, (len(chain.axes),)))
    dtype = T_torso_sole.dtype
    lower, upper = jnp.asarray(chain.lower, dtype), jnp.asarray(chain.upper, dtype)

    def newton(_: IntScalar, joint_pos: Float[Array, " k"]) -> Float[Array, " k"]:
        matrix, rhs = _newton_equations(joint_pos, T_torso_sole, chain)
        step = _step_within(matrix, rhs, lower - joint_pos, upper - joint_pos)
        return jnp.clip(joint_pos + jnp.clip(step, -LARGEST_STEP, LARGEST_STEP), lower, upper)

    return lax.fori_loop(0, iterations, newton, jnp.clip(guess.astype(dtype), lower, upper))


def _newton_equations(joint_pos: Array, T_torso_sole: Array, chain: LegChain) -> tuple[Array, Array]:
    """Return matrix and right side of the damped Newton step, lengths relative to that of the leg."""
    R_torso_sole, position, axes, points = _sole_and_axes(joint_pos, chain)
    length = float(abs(chain.sole[2, 3] - chain.points[0, 2]))
    turn = T_torso_sole[:3, :3] @ R_torso_sole.T
    about = 0.5 * jnp.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    error = jnp.concatenate([(T_torso_sole[:3, 3] - position) / length, about])
    jacobian = jnp.concatenate([jnp.cross(axes, position[None] - points) / length, axes], axis=1).T
    # Weights are along the axes of the sole.
    to_sole = jnp.zeros((6, 6), error.dtype).at[:3, :3].set(R_torso_sole.T).at[3:, 3:].set(R_torso_sole.T)
    weighted = jnp.asarray(chain.weights, error.dtype)[:, None] * to_sole
    error, jacobian = weighted @ error, weighted @ jacobian
    damping = DAMPING * jnp.minimum(jnp.sum(error**2), LARGEST_ERROR) + LEAST_DAMPING
    matrix = jacobian.T @ jacobian + damping * jnp.eye(len(joint_pos), dtype=error.dtype)
    return matrix, jacobian.T @ error


def _step_within(matrix: Array, rhs: Array, lowest: Array, highest: Array) -> Array:
    """Solve for a step; entries beyond their limits are set to them, and the others solved again."""
    step = _solve(matrix, rhs)
    is_free = (step >= lowest) & (step <= highest)
    at_limit = jnp.where(is_free, 0.0, jnp.clip(step, lowest, highest))
    both_free = is_free[:, None] & is_free[None, :]
    reduced = jnp.where(both_free, matrix, jnp.eye(len(rhs), dtype=rhs.dtype))
    return _solve(reduced, jnp.where(is_free, rhs - matrix @ at_limit, at_limit))


def _sole_and_axes(joint_pos: Array, chain: LegChain) -> tuple[Array, Array, Array, Array]:
    """Return rotation and position of the sole, and each joint's axis and a point on it (torso frame)."""
    dtype = joint_pos.dtype
    rotation, shift = jnp.eye(3, dtype=dtype), jnp.zeros(3, dtype)
    axes, points = [], []
    for angle, axis, point in zip(joint_pos, chain.axes, chain.points, strict=True):
        axis, point = jnp.asarray(axis, dtype), jnp.asarray(point, dtype)
        axes.append(rotation @ axis)
        points.append(rotation @ point + shift)
        turned = _rotation(axis, angle)
        shift = points[-1] - rotation @ turned @ point
        rotation = rotation @ turned
    sole = jnp.asarray(chain.sole, dtype)
    return rotation @ sole[:3, :3], rotation @ sole[:3, 3] + shift, jnp.stack(axes), jnp.stack(points)


def _rotation(axis: Array, angle: Array) -> Array:
    """Return the rotation about a unit axis by Rodrigues' formula."""
    x, y, z = axis
    zero = jnp.zeros_like(x)
    cross = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    return jnp.eye(3, dtype=axis.dtype) + jnp.sin(angle) * cross + (1.0 - jnp.cos(angle)) * (cross @ cross)


def _solve(matrix: Array, rhs: Array) -> Array:
    """Solve a small positive definite system by Cholesky's method; a batch of it fuses to one loop."""
    size = len(rhs)
    lower = [[rhs[0]] * size for _ in range(size)]
    half: list[Array] = []
    for i in range(size):
        for j in range(i + 1):
            rest = matrix[i, j] - sum((lower[i][k] * lower[j][k] for k in range(j)), jnp.zeros_like(rhs[0]))
            lower[i][j] = jnp.sqrt(rest) if i == j else rest / lower[j][j]
        half.append(
            (rhs[i] - sum((lower[i][k] * half[k] for k in range(i)), jnp.zeros_like(rhs[0]))) / lower[i][i]
        )
    solution = list(half)
    for i in reversed(range(size)):
        rest = half[i] - sum((lower[k][i] * solution[k] for k in range(i + 1, size)), jnp.zeros_like(rhs[0]))
        solution[i] = rest / lower[i][i]
    return jnp.stack(solution)

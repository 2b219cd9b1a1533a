"""Find the angles at which a humanoid stands with bent knees, and check the kinematics of its legs."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from creps_jax.robots.humanoid import LegChain
from creps_jax.robots.mjcf_legs import (
    FIRST_BEND,
    Leg,
    foot_pose,
    leg_length,
    mirrored_axes,
    pitch_joints,
    posed,
)
from creps_jax.robots.mjcf_settings import ROUNDING, numbers
from creps_jax.robots.mjcf_soles import Sole
from creps_jax.robots.screw_kinematics import chain_fk, chain_ik

# Only `humanoid_from_mjcf` is public.
__all__: list[str] = []

# Height of the hip, as a share of the leg's length.
_STANDING_HEIGHT = 0.88
_KINEMATICS_TOLERANCE = 1e-4


def standing_posture(
    chains: Sequence[LegChain],
    legs: Sequence[Leg],
    soles: Sequence[Sole],
    names: Sequence[str],
    held: Mapping[str, float],
    crouches: Sequence[np.ndarray] | None,
) -> np.ndarray:
    """Return the angles of standing: soles level and below the hips, knees bent, found from the crouch.

    Raises:
        ValueError: If a sole does not reach its place.
    """
    posture = np.array([held.get(name, 0.0) for name in names])
    guesses = [_bent(chain, leg) for chain, leg in zip(chains, legs, strict=True)]
    for chain, leg, sole, guess in zip(chains, legs, soles, crouches or guesses, strict=True):
        angles = _stand_on(chain, leg, sole, guess)
        for name, angle in zip(leg.joints, angles, strict=True):
            posture[list(names).index(name)] = angle
    return posture


def crouches_of_both(crouch: Any, chains: Sequence[LegChain], legs: Sequence[Leg]) -> list[np.ndarray]:
    """Return the angles of both legs with bent knees, from the checked angles of the left leg.

    Raises:
        ValueError: If there is not one angle for each joint, or one is out of its range.
    """
    left = _checked_crouch(crouch, chains[0], legs[0])
    # The right leg's angles have the sign of its axes relative to the mirrored ones.
    return [left, np.sign(np.sum(mirrored_axes(chains[0]) * chains[1].axes, axis=1)) * left]


def _checked_crouch(crouch: Any, chain: LegChain, leg: Leg) -> np.ndarray:
    """Return the angles of the left leg with bent knees after checking them."""
    expected = f"have an angle for each of {', '.join(leg.joints)}"
    angles = numbers("crouch", crouch, len(leg.joints), expected)
    _, knee, _ = pitch_joints(chain.axes, leg)
    for i in (knee, *range(len(angles))):
        if not chain.lower[i] - ROUNDING <= angles[i] <= chain.upper[i] + ROUNDING:
            why = ", where the knee is bent forwards" if i == knee else ""
            raise ValueError(
                f"crouch must have {leg.joints[i]!r} from {chain.lower[i]:.2f} to {chain.upper[i]:.2f} rad"
                f"{why}, got {angles[i]:g}"
            )
    return angles


def _bent(chain: LegChain, leg: Leg) -> np.ndarray:
    """Return the angles of a leg with its knee bent forwards."""
    angles = np.zeros(len(leg.joints))
    for joint, turn in zip(pitch_joints(chain.axes, leg), (-0.5, 1.0, -0.5), strict=True):
        angles[joint] = turn * FIRST_BEND * np.sign(chain.axes[joint, 1])
    return angles


def _stand_on(chain: LegChain, leg: Leg, sole: Sole, guess: np.ndarray) -> np.ndarray:
    """Return the angles with which the sole is level, and the ankle below the hip."""
    x, _, z = chain.points[pitch_joints(chain.axes, leg)[0]]
    pose = np.eye(4)
    pose[:3, 3] = x, sole.place[1], z - _STANDING_HEIGHT * leg_length(chain, leg) - sole.ankle_height
    solve = jax.jit(lambda pose, guess: chain_ik(pose, guess, chain, iterations=100))
    angles = solve(jnp.asarray(pose, jnp.float32), jnp.asarray(guess, jnp.float32))
    found = np.asarray(chain_fk(angles, chain))
    apart = np.abs(found - pose)[:3, 3].max()
    if apart > 0.01:
        raise ValueError(
            f"the leg {', '.join(leg.joints)} must reach the floor below its hip with its knee bent, got a "
            f"sole {apart:.3f} m off: name a crouch, or correct the ranges of the joints"
        )
    return np.asarray(angles, float)


def check_kinematics(
    model: mujoco.MjModel,
    chains: Sequence[LegChain],
    legs: Sequence[Leg],
    soles: Sequence[Sole],
    held: Mapping[str, float],
) -> None:
    """Compare our forward kinematics with MuJoCo's at random angles.

    Raises:
        ValueError: If they differ.
    """
    rng = np.random.default_rng(0)
    for chain, leg, sole in zip(chains, legs, soles, strict=True):
        fk = jax.jit(lambda angles, chain=chain: chain_fk(angles, chain))
        for _ in range(20):
            angles = rng.uniform(np.maximum(chain.lower, -1.5), np.minimum(chain.upper, 1.5)).astype(
                np.float32
            )
            theirs = foot_pose(
                model, posed(model, held, dict(zip(leg.joints, angles.tolist(), strict=True))), leg
            )
            error = np.abs(np.asarray(fk(jnp.asarray(angles))) - theirs @ sole.T_foot_sole).max()
            if not error < _KINEMATICS_TOLERANCE:
                raise ValueError(
                    f"the pose of {leg.foot!r} must follow from the joints {', '.join(leg.joints)}, got "
                    f"{error:.2g} m between our kinematics and MuJoCo's: are joints of the leg coupled?"
                )

"""Play a walk without feedback, as it is planned."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import lax

from creps_jax import checks
from creps_jax.typing import Array, Float
from creps_jax.walking.controller import Gait, Walker, WalkerState
from creps_jax.walking.posture import Balance

__all__ = ["open_loop_walk"]


@checks.arguments
def open_loop_walk(walker: Walker, commands: Float[Array, "n 3"]) -> WalkerState:
    """Walk from standing as planned: the trunk leans as intended and heads as planned at all times.

    There is no posture feedback, neither by the gains gamma_tilt and gamma_roll nor by `Balance`.

    Args:
        walker: The walker.
        commands: Command (vx, vy, turn rate) of each control period, m/s and rad/s.

    Returns:
        The states from time 0 on, one a period, stacked along a leading axis of n + 1. `set_point` holds the
        set-points of the joints, and `walker.pose` gives the pose of a state. The gains of `gait` are 1.

    Raises:
        ValueError: If the commands have another shape or are not finite.
    """
    checks.finite("commands", commands)

    def gait(command: Float[Array, "3"]) -> Gait:
        wanted = walker.gait(command)
        # With gains of 1 the legs are posed for the intended lean, whatever lean is measured.
        one = jnp.ones_like(wanted.params.lean)
        return wanted._replace(params=wanted.params._replace(tilt_gain=one, roll_gain=one))

    undisturbed = dataclasses.replace(walker, gait=gait, balance=Balance())

    def step(state: WalkerState, command: Float[Array, "3"]) -> tuple[WalkerState, WalkerState]:
        measured = jnp.zeros_like(state.origin).at[2].set(state.origin[2])
        state, _ = undisturbed.step(state, command, measured)
        return state, state

    start = undisturbed.start()
    _, states = lax.scan(step, start, commands.astype(start.command.dtype))
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, states)

"""The walker follows commands, continues the motion of the CoM from step to step, stops and starts."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from creps_jax.walking.com import com_velocities
from creps_jax.walking.com_plan import com_heights, plan_com
from creps_jax.walking.controller import Gait, Stage, Walker
from creps_jax.walking.engine import StepPlan, body_pose
from creps_jax.walking.footsteps import next_footstep, relative_pose, standing
from creps_jax.walking.gaits import AHEAD, limited_command, straight_walker
from creps_jax.walking.params import params_from_theta
from creps_jax.walking.posture import Balance

THETA = jnp.array([0.002, 0.17, 0.03, 0.24, 1.0, 0.4, 0.3, 0.05, 0.02, 0.12])
UPRIGHT = jnp.zeros(3)


def steered(command):
    """Step in proportion to the command."""
    params = params_from_theta(THETA)
    return Gait(params, params.step_duration * command)


def walk(walker, commands, measured=UPRIGHT):
    """Return the states and set-points of a walk that goes as it is planned."""

    def step(state, command):
        yaw = jnp.stack([0.0, 0.0, state.origin[2]])
        state, set_point = walker.step(state, command, measured + yaw)
        return state, (state, set_point)

    return jax.jit(lambda commands: lax.scan(step, walker.start(), commands)[1])(commands)


def constant(command, num):
    return jnp.tile(jnp.asarray(command, jnp.float32), (num, 1))


def planned_in_the_world(params, step, times):
    """Plan a walk of twelve equal steps in advance, in the frame of the world, and return its poses."""

    def plan_next(stance, _):
        footstep, after = next_footstep(params, stance, step)
        com = plan_com(params, stance.body[:2], footstep.support[:2], after.body[:2])
        return after, StepPlan(footstep, com.position, jnp.stack([stance.body[2], after.body[2]]))

    plans = lax.scan(plan_next, standing(), length=12)[1]

    def pose_at(time):
        phase = time / params.step_duration
        plan = jax.tree.map(lambda leaf: leaf[phase.astype(jnp.int32)], plans)
        return body_pose(params, plan, phase % 1.0)

    return jax.vmap(pose_at)(times)


@pytest.mark.parametrize("step", [(0.05, 0.0, 0.0), (0.03, 0.02, 0.1), (-0.03, -0.02, -0.1)])
def test_the_one_step_walk_is_the_walk_that_is_planned_in_advance(step):
    params, step = params_from_theta(THETA), jnp.array(step)
    wanted = jax.jit(planned_in_the_world)(params, step, 0.011 * jnp.arange(1.0, 200.0))
    walker = straight_walker(THETA, period=0.011)
    walker = dataclasses.replace(walker, gait=lambda _: Gait(params, step))
    states, _ = walk(walker, constant(AHEAD, 199))
    found = jax.vmap(walker.pose)(states)
    for name in wanted._fields:
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=1e-4, err_msg=name)


def random_commands(seed, num=1500, hold=75):
    rng = np.random.default_rng(seed)
    commands = rng.uniform([-0.2, -0.1, -0.6], [0.4, 0.1, 0.6], (num // hold, 3))
    return jnp.asarray(np.repeat(commands, hold, axis=0), jnp.float32)


@pytest.mark.parametrize("seed", range(3))
def test_position_and_velocity_of_the_com_are_continuous_whatever_is_commanded(seed):
    walker = Walker(steered)
    states, _ = walk(walker, random_commands(seed))
    heights = com_heights(params_from_theta(THETA))
    duration = float(THETA[3])
    begins = 1 + np.flatnonzero(np.diff(np.asarray(states.time)) < 0)
    assert len(begins) > 100
    jumps = []
    for tick in begins:
        before, after = (
            jax.tree.map(lambda leaf, tick=tick: leaf[tick], states) for tick in (tick - 1, tick)
        )
        body = before.after.body
        position = relative_pose(body, jnp.append(before.plan.com[-1], body[2]))[:2]
        velocity = relative_pose(body.at[:2].set(0.0), jnp.append(before.com_velocity, body[2]))[:2]
        np.testing.assert_allclose(after.plan.com[0], position, atol=1e-5)
        # The ZMP begins in the middle of the feet, the origin of the step's frame.
        zmp = jnp.zeros(len(heights[0]))
        begun = [com_velocities(after.plan.com[:, axis], zmp, *heights, duration)[0] for axis in (0, 1)]
        jumps.append(np.abs(np.array(begun) - np.asarray(velocity)))
    assert np.quantile(jumps, 0.99) < 2e-3 and np.max(jumps) < 0.05


def test_the_one_step_solution_jumps_where_the_continuous_one_does_not():
    commands = constant([0.4, 0.0, 0.0], 150)
    forward = {
        com: np.asarray(walk(Walker(steered, com=com), commands)[0].com_velocity[:, 0])
        for com in ("one_step", "continuous")
    }
    # While it speeds up, one step alone ends far faster than the next one begins.
    assert np.max(forward["one_step"]) > 0.35 and np.max(forward["continuous"]) > 0.35


def test_it_stops_side_by_side_stands_still_and_goes_on():
    commands = jnp.concatenate(
        [constant([0.4, 0.05, 0.3], 150), constant([0.0, 0.0, 0.0], 250), constant([0.3, 0.0, 0.0], 150)]
    )
    states, set_points = walk(Walker(steered), commands)
    stage = np.asarray(states.stage)
    assert stage[149] == Stage.WALKING and np.all(stage[330:400] == Stage.STANDING)
    assert np.ptp(np.asarray(set_points[360:400]), axis=0).max() < 1e-4
    feet = relative_pose(states.after.left[380], states.after.right[380])
    np.testing.assert_allclose(feet, [0.0, -0.11, 0.0], atol=2e-3)
    assert {Stage.STARTING, Stage.WALKING} <= set(stage[400:].tolist())
    assert stage[-1] == Stage.WALKING


def test_it_walks_where_the_command_says():
    states, _ = walk(Walker(steered, acceleration=(1e3,) * 3), constant([0.2, 0.0, 0.5], 1000))
    ticks = np.array([500, 900])
    x, y, _ = np.asarray(states.origin)[ticks].T
    # On a circle of radius v / w through the origin.
    radius = 0.2 / 0.5
    np.testing.assert_allclose(np.hypot(x, y - radius), radius, atol=0.05)


@pytest.mark.parametrize("turns", [-2, 1, 5])
def test_the_measured_heading_counts_modulo_a_turn(turns):
    walker = Walker(steered)
    commands = constant([0.2, 0.0, 0.8], 400)
    _, once = walk(walker, commands)
    _, again = walk(walker, commands, jnp.array([0.0, 0.0, turns * 2.0 * np.pi]))
    np.testing.assert_allclose(once, again, atol=5e-4)


@pytest.mark.parametrize("period", [0.01, 0.012])
def test_the_walk_does_not_depend_on_the_period(period):
    coarse, _ = walk(Walker(steered, period=0.002), constant([0.2, 0.0, 0.0], 1500))
    fine, _ = walk(Walker(steered, period=period), constant([0.2, 0.0, 0.0], round(3.0 / period)))
    distance = float(coarse.origin[-1, 0]) - float(fine.origin[-1, 0])
    assert abs(distance) < 0.05


def test_the_command_changes_no_faster_than_the_acceleration():
    walker = Walker(steered, acceleration=(0.5, 0.4, 2.0))
    states, _ = walk(walker, random_commands(0))
    change = np.abs(np.diff(np.asarray(states.command), axis=0)) / walker.period
    assert np.all(change <= np.array([0.5, 0.4, 2.0]) * (1 + 1e-3))


def test_commands_are_moved_into_the_ellipsoid():
    low, high = jnp.array([-0.2, -0.1, -0.8]), jnp.array([0.6, 0.1, 0.8])
    limited = partial(limited_command, low=low, high=high)
    inside = jnp.array([0.3, 0.05, 0.2])
    np.testing.assert_allclose(limited(inside), inside, atol=1e-7)
    for corner in ([0.6, 0.1, 0.8], [5.0, 0.0, 0.0]):
        found = (limited(jnp.array(corner)) - 0.5 * (low + high)) / (0.5 * (high - low))
        np.testing.assert_allclose(np.linalg.norm(found), 1.0, rtol=1e-5)


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        ({"com": "two_step"}, "com must be one of continuous, one_step, got 'two_step'"),
        ({"period": 0.0}, "period must be finite and above 0, got 0.0"),
        (
            {"balance": Balance(filter_time=-0.1)},
            "balance.filter_time must be finite and at least 0, got -0.1",
        ),
        ({"acceleration": (1.0, 1.0, -1.0)}, "acceleration must be finite and above 0"),
    ],
)
def test_bad_settings_are_named(setting, expected):
    with pytest.raises(ValueError, match=expected):
        Walker(**({"gait": steered} | setting))

"""Conditions of a walk: what each means, and that the walk gets it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax.numerics.rotations import quat_to_rpy
from creps_jax.simulation import c
from creps_jax.simulation.models import load_nao
from creps_jax.simulation.world import changed_fields, world_of
from creps_jax.tasks.conditions import (
    circumstances_of,
    friction,
    payload,
    push,
    slope,
    slope_angle,
    upward,
)
from creps_jax.tasks.walking import WalkNoise, nao_walk, record_walk
from creps_jax.training import evaluate
from tests.oracles.walk_c import BALANCE

# A gait of about 0.33 m/s.
MIDDLE = (0.001, 0.176, 0.039, 0.224, 3.2, 0.46, 0.31, 0.074, 0.038, 0.11)
STILL = WalkNoise(0.0, 0.0, 0.0)
G = 9.81


@pytest.fixture(scope="module")
def model():
    return load_nao()


def drifting(model, num_substeps):
    """Stand in for the physics: the base goes on as it is, and sinks under its payload; quickly compiled."""
    del model, num_substeps

    def control_step(robot, before, after, speed, world=None):
        del before, after, speed
        moved = robot.qpos.at[:3].add(0.02 * robot.qvel[:3])
        return robot._replace(qpos=moved if world is None else moved.at[2].add(-0.001 * world.payload))

    return control_step


def world_under(model, *pairs):
    conditions, values = zip(*pairs, strict=True)
    return circumstances_of(conditions, jnp.array(values), world_of(model)).world


def test_a_floor_that_rises_ahead_has_gravity_point_backwards(model):
    gravity = world_under(model, (slope(-5.0, 5.0), 5.0)).gravity
    np.testing.assert_allclose(
        gravity, [-G * np.sin(np.radians(5)), 0.0, -G * np.cos(np.radians(5))], rtol=1e-6
    )
    for degrees in (-30.0, -5.0, 0.0, 10.0):
        world = world_under(model, (slope(-40.0, 40.0), degrees))
        np.testing.assert_allclose(jnp.linalg.norm(world.gravity), G, rtol=1e-6)
        np.testing.assert_allclose(slope_angle(world), np.radians(degrees), atol=1e-6)
        np.testing.assert_allclose(upward(world) @ world.gravity, -G, rtol=1e-6)


def test_a_payload_adds_its_weight_to_the_torso(model):
    fields = changed_fields(model, world_under(model, (payload(0.0, 1.0), 0.7)))
    added = np.asarray(fields["body_mass"]) - model.body_mass
    assert added[model.body("torso").id] == pytest.approx(0.7, abs=1e-6)
    # The weight is m g more.
    assert G * added.sum() == pytest.approx(0.7 * G, abs=1e-5)


def test_friction_multiplies_that_of_sliding_alone(model):
    fields = changed_fields(model, world_under(model, (friction(0.1, 1.0), 0.4)))
    np.testing.assert_allclose(fields["geom_friction"], model.geom_friction * [0.4, 1.0, 1.0], rtol=1e-6)


def test_the_world_of_a_model_changes_nothing_in_it(model):
    for name, value in changed_fields(model, world_of(model)).items():
        there = model.opt.gravity if name == "opt.gravity" else getattr(model, name)
        np.testing.assert_array_equal(value, there.astype(np.float32))


def test_several_conditions_at_once_each_have_their_value(model):
    world = world_under(model, (payload(0.0, 1.0), 0.5), (slope(-5.0, 5.0), 3.0), (friction(0.2, 1.0), 0.8))
    np.testing.assert_allclose([world.payload, world.friction], [0.5, 0.8])
    np.testing.assert_allclose(slope_angle(world), np.radians(3.0), rtol=1e-5)


@pytest.fixture(scope="module")
def drift():
    """Return (slope in degrees, payload, push at 0.1 s) -> a walk of 0.2 s in which the base only drifts."""
    conditions = (slope(-80.0, 80.0), payload(0.0, 2.0), push(-0.5, 0.5, time=0.1))
    settings = {"duration": 0.2, "noise": STILL, "conditions": conditions, "physics": drifting}
    walk = jax.jit(
        lambda values: record_walk(jax.random.key(0), jnp.array(MIDDLE), values=values, **settings)
    )
    return lambda *values: walk(jnp.array(values))


def test_a_push_comes_once_at_its_time(drift):
    y = drift(0.0, 0.0, 0.3).qpos[:, 1]
    np.testing.assert_array_equal(y[:5], y[0])
    np.testing.assert_allclose(np.diff(y[4:]), 0.3 * 0.02, rtol=1e-4)


def test_a_push_in_the_last_control_step_is_felt():
    settings = {"duration": 0.2, "noise": STILL, "physics": drifting}
    last = push(-0.5, 0.5, time=0.189)
    walk = record_walk(
        jax.random.key(0), jnp.array(MIDDLE), values=jnp.array([0.3]), conditions=(last,), **settings
    )
    np.testing.assert_allclose(np.diff(walk.qpos[:, 1]), [*[0.0] * 8, 0.3 * 0.02], rtol=1e-4)


def test_the_physics_are_told_the_world(drift):
    height = drift(0.0, 2.0, 0.0).qpos[:, 2]
    np.testing.assert_allclose(np.diff(height), -0.002, rtol=1e-3)
    np.testing.assert_array_equal(np.diff(drift(0.0, 0.0, 0.0).qpos[:, 2]), 0.0)


def test_a_lean_counts_from_the_vertical(drift):
    for degrees in (-7.0, 0.0, 7.0):
        _, pitch, _ = quat_to_rpy(drift(degrees, 0.0, 0.0).qpos[0, 3:7])
        np.testing.assert_allclose(pitch, np.radians(MIDDLE[4] + degrees), atol=1e-5)


def test_hips_stand_above_the_feet_as_gravity_has_it(drift):
    level, rising = drift(0.0, 0.0, 0.0).pose, drift(7.0, 0.0, 0.0).pose
    ahead = rising.hips[:, 0] - level.hips[:, 0]
    np.testing.assert_allclose(ahead, level.hips[:, 2] * np.tan(np.radians(7.0)), rtol=1e-4)
    np.testing.assert_array_equal(rising.hips[:, 1:], level.hips[:, 1:])
    np.testing.assert_array_equal(rising.left, level.left)


def test_a_trunk_that_is_upright_has_not_fallen_on_any_slope(drift):
    # From the floor it leans by more than is a fall on level ground.
    assert not drift(55.0, 0.0, 0.0).has_fallen.any()


def test_contexts_are_drawn_from_all_ranges():
    task = nao_walk(0.1, 0.4, conditions=(slope(-5.0, 5.0), friction(0.5, 1.0)), physics=drifting)
    contexts = np.asarray(jax.vmap(task.sample_context)(jax.random.split(jax.random.key(0), 300)))
    assert contexts.shape == (300, 3)
    np.testing.assert_allclose(contexts.min(axis=0), [0.1, -5.0, 0.5], rtol=1e-6)
    np.testing.assert_allclose(contexts.max(axis=0), [0.4, 5.0, 1.0], rtol=1e-6)


@pytest.mark.usefixtures("relaxed_promotion")
def test_conditions_at_rest_change_no_walk_and_others_do():
    settings = {"duration": 3.0, "start_up": 1.0, "balance": BALANCE, "noise": STILL}
    settings["physics"] = c.make_control_step
    conditions = (slope(-8.0, 8.0), payload(0.0, 1.0), friction(0.5, 1.5), push(-1.0, 1.0, time=2.0))
    usual = jnp.array([0.3, 0.0, 0.0, 1.0, 0.0])
    changes = {"downhill": (1, -8.0), "uphill": (1, 8.0), "loaded": (2, 1.0), "pushed": (4, 0.3)}
    contexts = jnp.stack([usual, *(usual.at[i].set(value) for i, value in changes.values())])
    thetas = jnp.tile(jnp.array(MIDDLE), (len(contexts), 1))
    plain = evaluate(jax.random.key(0), nao_walk(**settings), usual[None, :1], thetas[:1])
    task = nao_walk(**settings, conditions=conditions)
    outcome = evaluate(jax.random.key(0), task, contexts, thetas)
    assert not outcome.fell.any()
    at_rest, *others = np.asarray(outcome.speed[:, 0])
    # Gravity has been through single precision.
    np.testing.assert_allclose(at_rest, plain.speed[0, 0], atol=1e-5)
    for name, other in zip(changes, others, strict=True):
        assert np.abs(other - at_rest).max() > 1e-3, name


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: slope(5.0, -5.0), r"low must be below high, got \[5\.\] and \[-5\.\]"),
        (lambda: slope(0.0, float("nan")), "high must be finite, got nan"),
        (lambda: slope(-90.0, 5.0), "slope must be above -90 and below 90, got -90.0 and 5.0"),
        (lambda: payload(-1.0, 1.0), "payload must be at least 0, got -1.0 and 1.0"),
        (lambda: friction(0.0, 1.0), "friction must be above 0, got 0.0 and 1.0"),
        (lambda: push(-1.0, 1.0, time=0.0), "time must be finite and above 0, got 0.0"),
        (lambda: nao_walk(conditions=(slope(0.0, 1.0), slope(0.0, 2.0))), "of its own, got slope, slope"),
        (
            lambda: nao_walk(duration=3.0, conditions=(push(0.0, 1.0),)),
            "the push must begin before the end at 3.0 s, both rounded to control steps of 0.02 s, got 3.0 s",
        ),
        (
            lambda: nao_walk(conditions=(push(0.0, 1.0, time=7.995),)),
            "before the end at 8.0 s, .* got 7.995 s",
        ),
        (
            lambda: record_walk(
                jax.random.key(0), jnp.array(MIDDLE), conditions=(slope(0.0, 1.0),), values=jnp.zeros(2)
            ),
            r"values must have shape \(1,\), one for each of the conditions, got \(2,\)",
        ),
    ],
)
def test_bad_settings_are_errors(make, match):
    with pytest.raises(ValueError, match=match):
        make()

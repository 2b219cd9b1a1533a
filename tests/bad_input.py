"""Call every public function with one bad argument, as users do: without the import hook of the other tests.

The hook would name wrong types before the library does. `test_bad_input.py` therefore runs this file in a
process of its own, without `conftest.py`. Nothing here compiles more than a few small operations.
"""

import contextlib
import dataclasses
import functools
import importlib
import inspect
import math
import os
import re
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import creps_jax as cj
from creps_jax import tasks
from creps_jax.files import policies_folder
from creps_jax.numerics import rotations
from creps_jax.policies.features import kernel_features, polynomial_features, scaled_polynomial_features
from creps_jax.policies.network import network_policy, start_network
from creps_jax.robots import mjcf, nao_geometry, screw_kinematics, spec
from creps_jax.robots.robot import NAO, NAO_H25
from creps_jax.search.archive import push
from creps_jax.search.dual import DualSolution
from creps_jax.search.fit import WeightedSamples, fit_within, weighted_ml
from creps_jax.simulation import c, mjx, models
from creps_jax.simulation.models import load_nao
from creps_jax.tasks import conditions, dmp, functions, planar_arm
from creps_jax.tasks.steering import SteeringReward, record_drive
from creps_jax.tasks.walking import WalkNoise, WalkReward, record_walk
from creps_jax.walking import (
    com,
    com_plan,
    engine,
    footsteps,
    gaits,
    open_loop,
    params,
    posture,
    set_points,
    swing,
    zmp,
)
from creps_jax.walking.posture import Balance
from tests.robots import small_humanoid

# What of an argument an error names, where it is a part of it.
NAMES = {
    "task": ("task", "rollout", "sample_context"),
    "start": ("start", "policy"),
    "state": ("state", "policy"),
}
NUM_EXAMPLES = int(os.environ.get("BAD_INPUT_EXAMPLES", "0"))
"""How many bad values of each argument to try, other ones each time; by default the same few."""
LIBRARY = str(Path(cj.__file__).parent)
EXPECTS = ("must", "has to", "have to", "needs", "needed", "takes")


class Spoilt(NamedTuple):
    """A bad value, and what of it an error has to show; None where the library may also bear it."""

    value: Any
    shown: str | None


class Argument(NamedTuple):
    """A good value, and what to put in its place."""

    good: Any
    spoilt: st.SearchStrategy[Spoilt]


def one_of(*spoilt: tuple[Any, str | None]) -> st.SearchStrategy[Spoilt]:
    return st.sampled_from([Spoilt(*pair) for pair in spoilt])


NONSENSE = one_of((None, "None"), ("three", "'three'"), ({"a": 1}, "{'a': 1}"), ([1.0, "a"], "[1.0, 'a']"))
NO_NUMBERS = NONSENSE | one_of(
    (2 - 1j, "(2-1j)"), (jax.random.key(0), "key<fry>"), ([[1.0], [1.0, 2.0]], "[[")
)


def no_number(*, least: float = -math.inf, above: float = -math.inf) -> st.SearchStrategy[Spoilt]:
    too_small = []
    if max(least, above) > -math.inf:
        bound = max(least, above)
        too_small = [
            st.floats(max_value=bound, exclude_max=least > above).map(lambda x: Spoilt(x, f"{x}")),
            one_of((np.float32(bound - 1), f"{bound - 1}"), (jnp.float32(bound - 1), f"{bound - 1}")),
        ]
    not_finite = one_of((math.nan, "nan"), (math.inf, "inf"), (-math.inf, "-inf"), (1e300, "1e+300"))
    return st.one_of(NO_NUMBERS, one_of((np.ones(2), "(2,)"), (True, "True")), not_finite, *too_small)


def number(good: float, **bounds: float) -> Argument:
    same = one_of((np.float32(good), None), (np.float64(good), None), (jnp.float32(good), None))
    return Argument(good, no_number(**bounds) | same)


def count(good: int, least: int = 1) -> Argument:
    whole = st.integers(max_value=least - 1) | st.integers(min_value=2**31)
    return Argument(
        good,
        st.one_of(
            NO_NUMBERS,
            (whole | st.floats()).map(lambda x: Spoilt(x, f"{x}")),
            one_of((True, "True"), (np.int64(least - 1), f"{least - 1}"), (np.int64(good), None)),
            one_of((np.float32(2.5), "2.5"), (jnp.ones(3), "(3,)")),
        ),
    )


def not_none(spoilt: st.SearchStrategy[Spoilt]) -> st.SearchStrategy[Spoilt]:
    """Leave out None, which stands for a default."""
    return spoilt.filter(lambda bad: bad.value is not None)


def key(good: jax.Array) -> Argument:
    return Argument(
        good,
        NONSENSE
        | one_of((0, "0"), (jnp.zeros(2), "float32(2,)"), ([1, 2], "[1, 2]"), (np.uint32(7), "7"))
        | one_of((good[None], "key<fry>"), (jax.random.key_data(good)[..., :1], "uint32")),
    )


def function(good: Callable) -> Argument:
    return Argument(good, NONSENSE | one_of((0, "0"), (jnp.zeros(2), "(2,)")))


def array(
    good: Any, *, free: tuple[int, ...] = (), least: float | None = None, bears: tuple = ()
) -> Argument:
    """Spoil an array: the sizes of the `free` axes may be larger, `bears` are entries that it may hold."""
    good = np.asarray(good, np.float32)

    def shapes(draw: st.DrawFn) -> Spoilt:
        if good.ndim == 0:
            return draw(one_of((np.ones(1), "(1,)"), (jnp.ones((2, 3)), "(2, 3)")))
        axis = draw(st.integers(0, good.ndim - 1))
        size = draw(st.sampled_from([0] if axis in free else [0, good.shape[axis] + 1]))
        resized = np.resize(good, (*good.shape[:axis], size, *good.shape[axis + 1 :]))
        value = draw(st.sampled_from([resized, good[None], good[..., None], good[0], np.float32(1)]))
        return Spoilt(value if draw(st.booleans()) else jnp.asarray(value), str(value.shape))

    def entries(draw: st.DrawFn) -> Spoilt:
        bad = draw(
            st.sampled_from([math.nan, math.inf, -math.inf, 1e30, *([] if least is None else [least - 1])])
        )
        value = good.copy()
        value[draw(st.tuples(*(st.integers(0, size - 1) for size in good.shape)))] = bad
        is_bearable = bad in bears or abs(bad) == 1e30 or (math.isnan(bad) and any(map(math.isnan, bears)))
        return Spoilt(value if draw(st.booleans()) else jnp.asarray(value), None if is_bearable else f"{bad}")

    types = one_of(
        *((good.astype(dtype), None) for dtype in (float, np.float16, int, bool)),
        (good.tolist(), None),
        (good.astype(complex), "complex"),
        (good.astype(str), str(good.shape)),
        (np.full(good.shape, None), str(good.shape)),
    )
    return Argument(good, NO_NUMBERS | types | st.composite(shapes)() | st.composite(entries)())


def vector(good: Any, *, bears: tuple = ()) -> Argument:
    """Spoil a setting that is a number or a vector."""
    length = np.size(good)
    wrong = one_of(*((np.full(shape, 0.3), f"{shape}|0.3 0.3") for shape in ((0,), (length + 2,), (1, 1, 1))))
    entries = [x for x in (math.nan, math.inf, -math.inf) if x not in bears]
    not_finite = one_of(
        *(((*np.ravel(good)[1:].tolist(), x), f"{x}") for x in entries), (1e300, "1e+300|inf")
    )
    same = one_of((np.asarray(good, float), None), (jnp.asarray(good, jnp.float32), None))
    return Argument(good, NO_NUMBERS | wrong | not_finite | same)


def record(good: Any, *others: tuple[Any, str | None], **fields: Argument) -> Argument:
    """Spoil a record: something else, or one field of it."""
    spoilt = [NONSENSE, one_of((0, "0"), (jnp.zeros(2), "(2,)"), *others)]
    if isinstance(good, tuple):
        spoilt.append(one_of((tuple(good), "(")))
    for name, argument in fields.items():
        replace = partial(_replace, good, name)
        spoilt.append(argument.spoilt.map(lambda bad, replace=replace: Spoilt(replace(bad.value), bad.shown)))
    return Argument(good, st.one_of(spoilt))


def _replace(record: Any, name: str, value: Any) -> Any:
    return (
        record._replace(**{name: value})
        if isinstance(record, tuple)
        else dataclasses.replace(record, **{name: value})
    )


def optional(argument: Argument) -> Argument:
    return Argument(
        argument.good,
        argument.spoilt.map(
            lambda bad: bad._replace(shown=bad.shown and None if bad.value is None else bad.shown)
        ),
    )


KEY = jax.random.key(0)
N, S, D = 6, 1, 2
CONTEXTS, THETAS, REWARDS = np.linspace(0, 1, N)[:, None], np.ones((N, D)), np.arange(N)
FEATURES = cj.linear_features(S)
ALGORITHM = cj.creps(FEATURES, FEATURES, archive_size=8)
POLICY = cj.LinearGaussian(jnp.ones((FEATURES.size, D)), jnp.eye(D))
STATE = ALGORITHM.init(POLICY)


def rollout(key: Any, context: Any, theta: Any) -> tasks.PlainOutcome:
    return tasks.PlainOutcome(-jnp.sum(theta**2), jnp.zeros(0))


TASK = cj.Task(cj.uniform_contexts(0.0, 1.0), rollout, S, D, worst_reward=-10.0)
# Learns nothing, and compiles at once.
QUICK = dataclasses.replace(
    ALGORITHM,
    tell=lambda state, batch: (
        state._replace(archive=push(state.archive, batch), iteration=state.iteration + 1),
        (),
    ),
)


def policy(good: cj.LinearGaussian = POLICY) -> Argument:
    diagonal = [np.diag([1.0, x]) for x in (0.0, -1.0)]
    return record(
        good,
        *((good._replace(cov_chol=x), str(x[1, 1])) for x in diagonal),
        (good._replace(cov_chol=np.array([[1.0, 0.5], [0.5, 1.0]])), "0.5"),
        coef=array(good.coef),
        cov_chol=array(good.cov_chol),
    )


def state() -> Argument:
    other = cj.creps(cj.linear_features(3), cj.linear_features(3), archive_size=14)
    start = cj.LinearGaussian(jnp.ones((4, 3)), jnp.eye(3))
    return record(STATE, (POLICY, "LinearGaussian"), (other.init(start), "3)"), policy=policy())


def features(good: cj.FeatureMap = FEATURES) -> Argument:
    return record(
        good,
        (cj.linear_features, "linear_features"),
        (good._replace(apply=lambda context: context), "(1,)"),
        (good._replace(apply=lambda context: 3.0), "()"),
        apply=function(good.apply),
        size=count(good.size),
        context_dim=count(good.context_dim),
        scale=optional(vector((1.0, 1.0))),
    )


def task() -> Argument:
    def with_outcome(make: Callable) -> cj.Task:
        return dataclasses.replace(TASK, rollout=lambda key, context, theta: make(theta))

    outcomes = {
        "None": lambda theta: None,
        "'good'": lambda theta: tasks.PlainOutcome("good", jnp.zeros(0)),
        "(2,)": lambda theta: tasks.PlainOutcome(theta, jnp.zeros(0)),
        "{'reward'": lambda theta: {"reward": 0.0},
        "(2,)|float32": lambda theta: theta,
        "complex64": lambda theta: tasks.PlainOutcome(1j * theta.sum(), jnp.zeros(0)),
    }
    bad_rollouts = [(with_outcome(make), shown) for shown, make in outcomes.items()]
    samples = {"(3,)": jnp.zeros(3), "()": jnp.zeros(()), "None": None, "[0.5]": [0.5]}
    bad_samplers = [
        (dataclasses.replace(TASK, sample_context=lambda key, x=x: x), shown) for shown, x in samples.items()
    ]
    return record(TASK, *bad_rollouts, *bad_samplers, (cj.sinus, "sinus"))


class Row(NamedTuple):
    """A function by its good arguments, and what to do with its result to see that it is good."""

    function: Callable
    arguments: dict[str, Argument]
    use: Callable = lambda result: result


def row(function: Callable, /, use: Callable = lambda result: result, **arguments: Argument) -> Row:
    return Row(function, arguments, use)


def use_task(task: cj.Task) -> Any:
    arguments = KEY, jnp.zeros(task.context_dim), jnp.zeros(task.theta_dim)
    return task.sample_context(KEY), jax.eval_shape(task.rollout, *arguments), task.worst_reward


def use_features(features: cj.FeatureMap) -> Any:
    return features.apply(jnp.full(features.context_dim, 0.3))


def use_sampler(sample_context: Callable) -> Any:
    return sample_context(KEY)


def use_run(result: tuple[cj.CrepsState, cj.IterationLog]) -> Any:
    return result[0].policy, result[1].mean_reward


SOLUTION = DualSolution(
    jnp.float32(1.0), jnp.ones(S), jnp.float32(0.0), num_steps=jnp.int32(3), is_active=jnp.asarray(True)
)
WALK_POSES = {
    "side": Argument(1.0, no_number() | one_of((0, "0"), (jnp.float32(0.5), "0.5"))),
    "robot": record(NAO),
}
ANY = (math.nan, math.inf, -math.inf)
DEVICES = optional(Argument(jax.devices(), NONSENSE | one_of((2, "2"), ([], "[]"), (["cpu"], "['cpu']"))))
FIT = {
    "features": array(np.column_stack([np.ones(N), CONTEXTS]), free=(1,)),
    "theta": array(THETAS * REWARDS[:, None], free=(1,)),
    "weights": array(np.full(N, 1 / N), least=0.0),
    "ridge": number(0.1, least=0.0),
    "scale": optional(array(np.ones(2))),
    "start": optional(array(np.zeros((2, D)))),
    "constant": optional(array(np.array([1.0, 0.0]))),
}
SAMPLES = {"reward": array(REWARDS, bears=ANY), "features": array(CONTEXTS, free=(1,), bears=ANY)}
RUN = {
    "key": key(KEY),
    "task": task(),
    "algorithm": record(QUICK, (cj.creps, "creps")),
    "start": policy(),
    "iterations": count(2),
    "samples": count(3),
    "first_samples": optional(count(3)),
    "on_iteration": function(lambda state, log: None),
    "devices": DEVICES,
}

SPACES = cj.Space("x", 0.0, 1.0), cj.Space(("a", "b"), (0.0, 0.0), (1.0, 1.0))
SPEED = cj.Space(("speed",), (0.0,), (1.0,), ("m/s",))
LEARNED = cj.Learned(POLICY, FEATURES, SPEED, SPACES[1])
KIND = network_policy(0.0, 1.0)
NETWORK = cj.Learned(start_network(KEY, KIND.features, D, hidden=3), KIND.features, SPEED, SPACES[1])
STRAIGHT = cj.load(policies_folder() / "walk.npz")
WALKER = cj.learned_walker(STRAIGHT)
FOLDER = Path(tempfile.mkdtemp())
LEARNED.save(FOLDER / "policy.npz")
NO_PATH = one_of((None, "None"), (5, "5"), (["a"], "['a']"))
MODEL = load_nao()
SMALL = mjcf.humanoid_from_mjcf(small_humanoid.write_model(FOLDER), **small_humanoid.SPEC)
SMALL_SPEC = FOLDER / "small.toml"
SMALL_SPEC.write_text(
    'model = "small.xml"\n' + "".join(f"{name} = {value}\n" for name, value in small_humanoid.SPEC.items())
)
CHAIN = record(SMALL.left)
NAMES_OF = {
    name: Argument(value, NONSENSE | one_of((3, "3"), (value[:1], value[0]), ([2, *value[1:]], "[2")))
    for name, value in small_humanoid.SPEC.items()
}
BY_JOINT = one_of((3, "3"), ("three", "'three'"), ({"head": "a"}, "'a'"), ({"a": 1}, "'a'"), ([0.1], "[0.1]"))
WALK = params.params_from_theta(jnp.asarray(np.mean(params.NAO_BOUNDS, axis=0), jnp.float32))
PLAN = WALKER.start().plan
POSE = engine.BodyPose(jnp.zeros(4), jnp.zeros(4), jnp.zeros(4), jnp.zeros(()))
VECTOR = array(np.ones(3), bears=ANY)
PLANAR = array(np.ones(2), bears=ANY)
MATRIX = array(np.eye(3), bears=ANY)
SCALAR = array(np.float32(0.5), bears=ANY)
JOINTS = array(np.zeros(nao_geometry.NUM_JOINTS), bears=ANY)
BALANCE = record(Balance())


def traced(function: Callable, /, use: Callable = lambda result: result, **arguments: Argument) -> Row:
    """Make the row of a function whose results are not to be computed: only their shapes are seen."""
    return Row(lambda **given: jax.eval_shape(lambda: use(function(**given))), arguments)


def made(function: Callable, /, **arguments: Argument) -> Row:
    """Make the row of a function whose result says nothing more than that it is there."""
    return Row(function, arguments, lambda _: ())


ROTATIONS = (rotations.rotation_x, rotations.rotation_y, rotations.rotation_z)
OF_VECTORS = (
    functions.ackley,
    functions.ellipsoid,
    functions.rastrigin,
    functions.rosenbrock,
    functions.sphere,
)


# Called with what a public function has checked, or for each robot in each step, where checks cost time.
INNER = {
    "com_heights",
    "com_velocities",
    "compose",
    "continuous_com_trajectory",
    "command_context",
    "command_range",
    "filter_memory",
    "is_steered",
    "vertical_trunk",
    "limited_command",
    "next_tilt",
    "relative_pose",
    "wrapped",
    "zmp_shares",
    "changed_fields",
    "initial_state",
    "leg_reach",
    "solve_legs",
    "read_servos",
    "substep_shares",
    "world_of",
}


class Done(Exception):
    """All settings have been checked."""


def stop(model: Any, num_steps: int) -> None:
    raise Done


def at_rest(model: Any, num_steps: int) -> Callable:
    """Return a physics in which the robot stays as it is."""
    return lambda robot, *_: robot


def before_physics(**given: Any) -> None:
    """Record a walk, but for its physics and what comes after."""
    with contextlib.suppress(Done):
        record_walk(**given)


def before_driving(**given: Any) -> None:
    """Record a drive, but for its physics and what comes after."""
    with contextlib.suppress(Done):
        record_drive(**given)


MOTION = {
    **{rotation.__name__: traced(rotation, angle=number(0.3)) for rotation in ROTATIONS},
    "arm_points": traced(planar_arm.arm_points, use=lambda _: (), joint_pos=array(np.zeros(3), bears=ANY)),
    "body_pose": traced(engine.body_pose, params=record(WALK), plan=record(PLAN), phase=SCALAR),
    "corrected_lean": traced(
        posture.corrected_lean,
        intended=array(np.zeros(2), bears=ANY),
        measured=array(np.zeros(2), bears=ANY),
        roll_gain=SCALAR,
        tilt_gain=SCALAR,
    ),
    "dmp_trajectory": traced(
        dmp.dmp_trajectory,
        weights=array(np.ones((3, 2)), free=(0,), bears=ANY),
        start=array(np.ones(2), bears=ANY),
        goal=array(np.ones(2), bears=ANY),
        duration=number(1.0, above=0.0),
        num_steps=count(5),
    ),
    "fit_dmp": traced(
        dmp.fit_dmp, use=lambda _: (), pos=array(np.ones((9, 2)), bears=ANY), num_basis=count(3)
    ),
    "hits_ground": traced(
        planar_arm.hits_ground,
        points=array(np.ones((4, 2)), free=(0,), bears=ANY),
        center=SCALAR,
        width=number(0.3),
        depth=number(1.0),
    ),
    "hole_movement": traced(planar_arm.hole_movement, theta=array(np.ones(18), bears=ANY)),
    "leg_indices": made(nao_geometry.leg_indices, side=WALK_POSES["side"]),
    "matrix_to_rpy": traced(rotations.matrix_to_rpy, rotation=MATRIX),
    "next_footstep": traced(
        footsteps.next_footstep, params=record(WALK), stance=record(footsteps.standing()), command=VECTOR
    ),
    "next_set_point": traced(set_points.next_set_point, set_point=JOINTS, target=JOINTS, period=number(0.02)),
    "open_loop_walk": traced(
        open_loop.open_loop_walk,
        walker=record(WALKER),
        commands=array(np.ones((2, 3)), free=(0,), bears=ANY),
    ),
    "params_from_theta": traced(params.params_from_theta, theta=array(np.ones(10), bears=ANY)),
    "plan_com": traced(com_plan.plan_com, params=record(WALK), start=PLANAR, support=PLANAR, end=PLANAR),
    "plan_continuous_com": traced(
        com_plan.plan_continuous_com,
        params=record(WALK),
        before=array(np.ones((2, 2)), bears=ANY),
        start=PLANAR,
        support=PLANAR,
        end=array(np.ones((2, 2)), bears=ANY),
    ),
    "pose_joints": traced(
        engine.pose_joints, params=record(WALK), pose=record(POSE), measured_rpy=VECTOR, balance=BALANCE
    ),
    "quat_to_matrix": traced(rotations.quat_to_matrix, quat=array(np.ones(4), bears=ANY)),
    "quat_to_rpy": traced(rotations.quat_to_rpy, quat=array(np.ones(4), bears=ANY)),
    "rigid_transform": traced(rotations.rigid_transform, rotation=MATRIX, position=VECTOR),
    "rpy_to_matrix": traced(rotations.rpy_to_matrix, rpy=VECTOR),
    "rpy_to_quat": traced(rotations.rpy_to_quat, rpy=VECTOR),
    "safe_arctan2": traced(rotations.safe_arctan2, use=lambda _: (), y=VECTOR, x=VECTOR),
    "spring_height": traced(
        com.spring_height,
        use=lambda _: (),
        phase=VECTOR,
        rest_height=SCALAR,
        amplitude=SCALAR,
        duration=SCALAR,
    ),
    "stand_upright": traced(engine.stand_upright, pose=record(POSE), slope=SCALAR),
    "swing_pose": traced(swing.swing_pose, start=VECTOR, end=VECTOR, height=SCALAR, phase=SCALAR),
    "via_point_movement": traced(planar_arm.via_point_movement, theta=array(np.ones(15), bears=ANY)),
    "zmp_of_com": traced(
        com.zmp_of_com,
        com=array(np.zeros(5), bears=ANY),
        com_height=array(np.full(5, 0.3), bears=ANY),
        com_height_acc=array(np.zeros(5), bears=ANY),
        duration=number(0.3),
    ),
    "zmp_reference": traced(
        zmp.zmp_reference,
        phase=array(np.linspace(0, 1, 5), free=(0,), bears=ANY),
        start=array(np.zeros(2), bears=ANY),
        support=array(np.zeros(2), bears=ANY),
        end=array(np.zeros(2), bears=ANY),
        double_support_share=SCALAR,
    ),
}

PHYSICS = {
    "friction": made(conditions.friction, low=number(0.5, above=0.0), high=number(1.0)),
    "make_control_step of c": made(c.make_control_step, model=record(MODEL), num_substeps=count(4)),
    "make_control_step of mjx": made(mjx.make_control_step, model=record(MODEL), num_substeps=count(4)),
    "payload": made(conditions.payload, low=number(0.0, least=0.0), high=number(1.0)),
    "push": made(conditions.push, low=number(-0.1), high=number(0.1), time=number(3.0, above=0.0)),
    "record_walk": made(
        before_physics,
        key=key(KEY),
        theta=array(np.ones(10), bears=ANY),
        duration=number(8.0, above=0.0),
        noise=record(WalkNoise(), lean=number(0.01, least=0.0)),
        balance=record(Balance(), heading_gain=number(0.0)),
        conditions=Argument((), NONSENSE | one_of((3, "3"))),
        model=optional(record(MODEL)),
        physics=function(stop),
    ),
    "record_drive": made(
        before_driving,
        key=key(KEY),
        walker=record(WALKER, (dataclasses.replace(WALKER, period=0.01), "0.01")),
        commands=array(np.zeros((5, 3)), free=(0,), bears=ANY),
        noise=record(WalkNoise(), lean=number(0.01, least=0.0)),
        conditions=Argument((), NONSENSE | one_of((3, "3"))),
        model=optional(record(MODEL)),
        physics=function(stop),
    ),
    "record_walk of conditions": traced(
        partial(record_walk, KEY, np.ones(10), duration=0.1, physics=at_rest),
        use=lambda record: record.time,
        conditions=Argument((conditions.slope(-5.0, 5.0),), one_of(((), "(1,)"), ((0.1,), "0.1"))),
        values=optional(array(np.zeros(1), bears=ANY)),
    ),
    "slope": made(conditions.slope, low=number(-5.0, above=-90.0), high=number(5.0)),
    "weighted_ml": traced(
        weighted_ml,
        policy=record(POLICY),
        samples=record(WeightedSamples(FIT["features"].good, FIT["theta"].good, FIT["weights"].good, None)),
        ridge=number(0.1, least=0.0),
        scale=optional(array(np.ones(2))),
        constant=optional(array(np.array([1.0, 0.0]))),
    ),
    **{of.__name__: traced(of, use=lambda _: (), x=VECTOR) for of in OF_VECTORS},
}


def update_once(search: Any) -> Any:
    """Return the shapes of the policy after an update."""
    return jax.eval_shape(
        lambda: search.tell(search.init(POLICY), cj.Batch(CONTEXTS, THETAS, REWARDS))[0].policy
    )


ROWS = {
    **MOTION,
    **PHYSICS,
    "Importance": row(
        cj.Importance, use=lambda _: (), num_policies=count(3), least_effective=number(5.0, least=1.0)
    ),
    "Task": row(
        cj.Task,
        use=use_task,
        sample_context=function(TASK.sample_context),
        rollout=function(rollout),
        context_dim=count(S),
        theta_dim=count(D),
        worst_reward=number(-10.0),
        contexts=optional(record(SPACES[0])),
        parameters=optional(record(SPACES[1])),
    ),
    "average_repeats": row(cj.average_repeats, use=use_task, task=record(TASK), repeats=count(3)),
    "bounded_ml": row(
        cj.bounded_ml,
        use=lambda _: (),
        mean_kl_bound=number(1.0, above=0.0),
        cov_kl_bound=number(0.1, above=0.0),
        entropy_loss_bound=optional(number(0.1, above=0.0)),
    ),
    "com_trajectory": row(
        cj.com_trajectory,
        zmp=array(np.linspace(0, 0.1, 5), bears=(math.nan, math.inf, -math.inf)),
        com_height=array(np.full(5, 0.3)),
        com_height_acc=array(np.zeros(5), least=-9.81),
        start=number(0.0),
        end=number(0.1),
        duration=number(0.3, above=0.0),
    ),
    "context_grid": row(cj.context_grid, low=vector(0.0), high=vector(1.0), num=count(3, least=2)),
    "creps": row(
        cj.creps,
        use=update_once,
        policy_features=features(),
        baseline_features=features(),
        kl_bound=number(0.5, above=0.0),
        archive_size=count(8),
        ridge=number(1e-4, least=0.0),
        m_step=function(weighted_ml),
        importance=optional(record(cj.Importance(3, 2.0))),
    ),
    "surrogate": row(
        cj.surrogate,
        use=update_once,
        policy_features=features(),
        baseline_features=features(),
        kl_bound=number(0.5, above=0.0),
        archive_size=count(16),
        ridge=number(1e-4, least=0.0),
        m_step=function(weighted_ml),
        gate=number(0.8, above=0.0),
    ),
    "creps.init": row(ALGORITHM.init, policy=policy()),
    "creps.ask": row(ALGORITHM.ask, key=key(KEY), state=state(), contexts=array(CONTEXTS, free=(0,))),
    "creps.mean": row(ALGORITHM.mean, policy=policy(), contexts=array(CONTEXTS, free=(0,))),
    "creps.tell": row(
        ALGORITHM.tell,
        use=lambda told: (told[0].policy, told[1]),
        state=state(),
        batch=record(
            cj.Batch(CONTEXTS, THETAS, REWARDS),
            (cj.Batch(CONTEXTS[:4], THETAS, REWARDS), "(4, 1)"),
            context=array(CONTEXTS, bears=ANY),
            theta=array(THETAS, bears=ANY),
            reward=array(REWARDS, free=(0,), bears=ANY),
        ),
    ),
    "contextual_function": row(
        tasks.contextual_function,
        use=use_task,
        function=function(lambda x: jnp.sum(x**2)),
        transform=array(np.ones((D, S)), free=(0, 1)),
        low=number(0.0),
        high=number(1.0),
    ),
    "evaluate": row(
        cj.evaluate,
        key=key(KEY),
        task=task(),
        contexts=array(CONTEXTS, bears=ANY),
        thetas=array(THETAS, bears=ANY),
        repeats=count(2),
        devices=DEVICES,
    ),
    "fit_weighted_ml": row(cj.fit_weighted_ml, **FIT),
    "gaussian_contexts": row(
        cj.gaussian_contexts,
        use=use_sampler,
        low=vector(0.0),
        high=vector(1.0),
        std=optional(vector(0.5)),
    ),
    "gaussian_contexts of two": row(
        cj.gaussian_contexts,
        use=use_sampler,
        low=vector((0.0, 0.1)),
        high=vector((1.0, 0.9)),
        std=vector((0.5, 0.1)),
    ),
    "hole_reaching": row(
        cj.hole_reaching,
        use=use_task,
        low=number(1.4),
        high=number(2.0),
        width=number(0.3, above=0.0),
        depth=number(1.0, above=0.0),
        sample_context=optional(function(TASK.sample_context)),
    ),
    "leg_fk": row(cj.leg_fk, joint_pos=array(np.zeros(6)), **WALK_POSES),
    "leg_ik": row(cj.leg_ik, T_torso_sole=array(np.eye(4)), **WALK_POSES),
    "chain_fk": traced(screw_kinematics.chain_fk, joint_pos=array(np.zeros(6)), chain=CHAIN),
    "chain_ik": traced(
        screw_kinematics.chain_ik,
        T_torso_sole=array(np.eye(4)),
        guess=array(np.zeros(6)),
        chain=CHAIN,
        iterations=count(3),
    ),
    "humanoid_from_mjcf": made(
        mjcf.humanoid_from_mjcf,
        path=Argument(FOLDER / "small.xml", NO_PATH),
        **NAMES_OF,
        name=Argument("small", one_of((3, "3"), (["a"], "['a']"))),
        crouch=Argument(None, one_of((3, "3"), (["a"] * 6, "'a'"), ([math.nan] * 6, "nan"))),
        held=Argument(None, BY_JOINT),
        arm_swing=Argument(None, BY_JOINT),
        kp=Argument(50.0, not_none(no_number(above=0.0))),
        kv=Argument(1.0, not_none(no_number(least=0.0))),
        max_speed=Argument(8.0, one_of((-1.0, "-1.0"), ("three", "'three'"), ({"head": 0}, "0"))),
        max_torque=Argument(8.0, not_none(no_number(above=0.0))),
        foot_spacing=Argument(0.12, not_none(no_number(above=0.0))),
        speeds=Argument((0.1, 0.3), one_of((3, "3"), ((0.3, 0.1), "(0.3, 0.1)"), (("a", "b"), "'a'"))),
    ),
    "humanoid_from_toml": made(spec.humanoid_from_toml, path=Argument(SMALL_SPEC, NO_PATH)),
    "humanoid_bounds": row(params.humanoid_bounds, robot=record(SMALL)),
    "scaled_bounds": row(params.scaled_bounds, robot=record(NAO)),
    "load_model": made(models.load_model, robot=record(SMALL)),
    "check_model": made(models.check_model, model=record(MODEL), robot=record(NAO)),
    "leg_ik of a shared motor": row(
        partial(cj.leg_ik, np.eye(4, dtype=np.float32), 1.0, robot=NAO_H25), yaw_pitch=optional(number(0.1))
    ),
    "Learned()": row(lambda values: list(LEARNED(values).values()), values=number(0.3)),
    "Space.unbounded": made(
        cj.Space.unbounded,
        names=Argument(("a", "b"), one_of((None, "None"), (3, "3"), ((), "()"), (("a", "a"), "'a', 'a'"))),
        units=Argument(("m", "rad"), one_of((("m",), "'m'"), ((1.0, 2.0), "1.0"))),
    ),
    "Space.contains": row(SPEED.contains, values=vector((0.3,))),
    "load": row(cj.load, use=lambda learned: learned.policy, path=Argument(FOLDER / "policy.npz", NO_PATH)),
    "save": row(
        cj.save,
        use=lambda _: 0,
        path=Argument(FOLDER / "again.npz", NO_PATH),
        learned=record(LEARNED),
    ),
    "fit_within": row(
        fit_within,
        use=lambda _: 0,
        mean_kl_bound=number(0.5, above=0.0),
        cov_kl_bound=number(0.05, above=0.0),
    ),
    "start_policy": row(
        cj.start_policy,
        features=features(),
        theta_dim=count(2),
        mean=vector((0.0, 1.0)),
        std=vector((1.0, 2.0)),
    ),
    "network_policy": row(
        network_policy,
        use=lambda _: (),
        low=vector(0.0),
        high=vector(1.0),
        steps=count(3),
        learning_rate=number(0.1, above=0.0),
        mean_kl_bound=number(1.0, above=0.0),
        cov_kl_bound=number(0.05, above=0.0),
        entropy_loss_bound=optional(number(0.1, above=0.0)),
    ),
    "start_network": row(
        start_network,
        key=key(KEY),
        features=features(network_policy(0.0, 1.0).features),
        theta_dim=count(2),
        hidden=count(3),
        mean=vector((0.5, 1.0)),
        std=vector((0.5, 1.0)),
    ),
    "linear_gaussian": row(
        cj.linear_gaussian,
        use=lambda _: 0,
        features=record(FEATURES),
        m_step=function(weighted_ml),
        ridge=number(0.1, least=0.0),
    ),
    "learned network": row(
        cj.Learned,
        use=lambda made: made.policy,
        policy=record(NETWORK.policy),
        features=record(NETWORK.features),
        contexts=record(SPEED),
        parameters=record(SPACES[1]),
        task=Argument({}, one_of((5, "5"), ("walk", "walk"))),
    ),
    "save a network": row(
        cj.save,
        use=lambda _: 0,
        path=Argument(FOLDER / "network.npz", NO_PATH),
        learned=record(NETWORK),
    ),
    "learned": row(
        cj.learned,
        use=lambda made: made.policy,
        task=record(dataclasses.replace(TASK, contexts=SPACES[0], parameters=SPACES[1])),
        algorithm=record(ALGORITHM, (cj.creps, "creps")),
        state=state(),
        made_for=optional(Argument({}, one_of((5, "5"), ("walk", "walk")))),
    ),
    "ellipsoid_contexts": row(cj.ellipsoid_contexts, use=use_sampler, low=vector(0.0), high=vector(1.0)),
    "ellipsoid_contexts()": row(cj.ellipsoid_contexts(0.0, 1.0), key=key(KEY)),
    "learned_walker": row(
        cj.learned_walker,
        use=lambda walker: walker.period,
        learned=record(STRAIGHT, (LEARNED, "speed, or vx, vy, turn")),
    ),
    "Walker": row(
        cj.Walker,
        use=lambda walker: walker.period,
        gait=function(lambda command: None),
        robot=record(NAO),
        period=number(0.02, above=0.0),
        balance=record(Balance()),
        acceleration=vector((0.4, 0.4, 2.0)),
        com=Argument("one_step", one_of(("two", "'two'"), (None, "None"), (3, "3"))),
    ),
    "steered_gait": traced(gaits.steered_gait, theta=array(np.ones(12), bears=ANY)),
    "straight_walker": traced(
        gaits.straight_walker, use=lambda walker: walker.start(), theta=array(np.ones(10), bears=ANY)
    ),
    "straight_gait": traced(gaits.straight_gait, theta=array(np.ones(10), bears=ANY)),
    "linear_features": row(cj.linear_features, use=use_features, dim=count(2)),
    "linear_features.apply": row(FEATURES.apply, context=array(np.ones(1), bears=ANY)),
    "make_iteration": row(
        cj.make_iteration,
        use=lambda step: jax.eval_shape(step, KEY, STATE),
        **{name: RUN[name] for name in ("task", "algorithm", "samples", "devices")},
    ),
    "make_iteration()": row(
        cj.make_iteration(TASK, QUICK, samples=3),
        use=lambda result: jax.tree.map(jnp.shape, result),
        key=key(KEY),
        state=state(),
    ),
    "nao_walk": row(
        cj.nao_walk,
        use=lambda task: (task.sample_context(KEY), task.worst_reward),
        low=number(0.1),
        high=number(0.6),
        duration=number(8.0),
        start_up=number(2.0, least=0.0),
        reward=record(WalkReward(), speed=number(10.0)),
        noise=record(WalkNoise(), lean=number(0.01, least=0.0)),
        balance=record(Balance(), heading_gain=number(0.0)),
        conditions=Argument((), NONSENSE | one_of((3, "3"))),
        sample_context=optional(function(TASK.sample_context)),
        robot=record(NAO, (NAO_H25, "range of the robot nao_h25")),
        model=optional(record(MODEL, (load_nao(NAO_H25), "-2.086 to 2.086"))),
        physics=function(lambda model, num_steps: None),
    ),
    "nao_steered_walk": row(
        cj.nao_steered_walk,
        use=lambda task: (task.sample_context(KEY), task.worst_reward),
        low=Argument((-0.2, -0.1, -0.8), NONSENSE),
        high=Argument((0.6, 0.1, 0.8), NONSENSE),
        profile=Argument(((0.0, 1.0, 1.0),), NONSENSE | one_of((((1.0, 1.0),), "((1.0, 1.0),)"))),
        duration=number(5.0),
        start_up=number(2.0, least=0.0),
        reward=record(SteeringReward(), speed=number(10.0, least=0.0)),
        noise=record(WalkNoise(), lean=number(0.01, least=0.0)),
        balance=record(Balance(), heading_gain=number(0.0)),
        conditions=Argument((), NONSENSE | one_of((3, "3"))),
        sample_context=function(cj.uniform_contexts((0.0,) * 3, (1.0,) * 3)),
        robot=record(NAO, (NAO_H25, "range of the robot nao_h25")),
        model=optional(record(MODEL, (load_nao(NAO_H25), "-2.086 to 2.086"))),
        physics=function(lambda model, num_steps: None),
        acceleration=vector((0.4, 0.4, 2.0)),
        com=Argument("one_step", one_of(("two", "'two'"), (None, "None"), (3, "3"))),
    ),
    "penalised": row(
        cj.penalised,
        use=use_task,
        task=record(TASK),
        low=vector((-1.0, -1.0), bears=(-math.inf,)),
        high=vector((1.0, 1.0), bears=(math.inf,)),
        penalty=number(10.0, least=0.0),
    ),
    "polynomial_features": row(polynomial_features, use=use_features, dim=count(2), degree=count(3)),
    "scaled_polynomial_features": row(
        scaled_polynomial_features,
        use=use_features,
        low=vector((0.0, 0.0)),
        high=vector((1.0, 2.0)),
        degree=count(3),
    ),
    "kernel_features": row(
        kernel_features,
        use=use_features,
        low=vector(0.0),
        high=vector(1.0),
        num=count(3),
        bandwidth=optional(vector(0.2)),
    ),
    "quadratic_features": row(cj.quadratic_features, use=use_features, dim=count(2)),
    "rbf_features": row(
        cj.rbf_features,
        use=use_features,
        low=vector(0.0),
        high=vector(1.0),
        num_centers=count(3),
        bandwidth=optional(vector(0.2)),
    ),
    "rbf_features.apply": row(cj.rbf_features(0.0, 1.0, 3).apply, context=array(np.ones(1))),
    "sample_weights": row(
        cj.sample_weights,
        solution=record(
            SOLUTION,
            temperature=number(1.0, above=0.0),
            baseline_coef=array(SOLUTION.baseline_coef),
        ),
        **SAMPLES,
        valid=optional(array(np.ones(N), bears=(*ANY, -1))),
    ),
    "sigmoid_constrained": row(
        cj.sigmoid_constrained,
        use=use_task,
        task=record(TASK),
        low=vector((-1.0, -1.0)),
        high=vector((1.0, 1.0)),
    ),
    "sigmoid_gate": row(
        cj.sigmoid_gate,
        # It takes any number of vectors.
        use=lambda gated: (jnp.isfinite(gated).all(), gated[..., :0].sum()),
        theta=array(np.zeros((3, 2)), bears=(math.inf, -math.inf)),
        low=vector((0.0, -1.0)),
        high=vector((1.0, 1.0)),
    ),
    "sinus": row(cj.sinus, use=use_task, low=number(0.0), high=number(3.0)),
    "solve_dual": row(
        lambda **given: jax.eval_shape(lambda: cj.solve_dual(**given)),
        **SAMPLES,
        valid=optional(array(np.ones(N), bears=(*ANY, -1))),
        kl_bound=number(0.5, above=0.0),
    ),
    "thomas_solve": row(
        cj.thomas_solve,
        lower=array(np.ones(4), bears=(math.nan,)),
        diag=array(np.full(4, 3.0)),
        upper=array(np.ones(4)),
        rhs=array(np.arange(4)),
    ),
    "train": row(cj.train, use=use_run, **RUN),
    "train_trials": row(
        cj.train_trials,
        use=use_run,
        keys=key(jax.random.split(KEY, 2)),
        **{**{name: argument for name, argument in RUN.items() if name != "key"}, "task": record(TASK)},
    ),
    "uniform_contexts": row(cj.uniform_contexts, use=use_sampler, low=vector(0.0), high=vector(1.0)),
    "uniform_contexts()": row(cj.uniform_contexts(0.0, 1.0), key=key(KEY)),
    "via_point_reaching": row(
        cj.via_point_reaching,
        use=use_task,
        low=vector((-1.5, -1.5)),
        high=vector((-0.5, -0.5)),
        sample_context=optional(function(cj.uniform_contexts((0.0, 0.0), (1.0, 1.0)))),
    ),
}
CASES = [(name, argument) for name, row in ROWS.items() for argument in row.arguments]


@functools.cache
def good_call(name: str) -> tuple[dict[str, Any], Any]:
    """Return the good arguments of a function, and what comes of them."""
    function, arguments, use = ROWS[name]
    good = {name: argument.good for name, argument in arguments.items()}
    return good, use(function(**good))


@pytest.mark.parametrize(("name", "argument"), CASES, ids=[f"{name}-{argument}" for name, argument in CASES])
def test_bad_input_is_named_or_borne(name, argument):
    function, arguments, use = ROWS[name]
    good, expected = good_call(name)

    @settings(
        max_examples=NUM_EXAMPLES or 4,
        deadline=None,
        derandomize=not NUM_EXAMPLES,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(arguments[argument].spoilt)
    def check(spoilt):
        try:
            result = use(function(**{**good, argument: spoilt.value}))
        except ValueError as error:
            check_error(error, argument, spoilt)
        else:
            check_result(result, expected)

    check()


def check_error(error: ValueError, argument: str, spoilt: Spoilt) -> None:
    traceback = error.__traceback__
    while traceback.tb_next is not None:
        traceback = traceback.tb_next
    place = traceback.tb_frame.f_code.co_filename
    assert place.startswith(LIBRARY), f"raised in {place}: {error!r}"
    message = str(error)
    assert "got" in message and any(word in message for word in EXPECTS), message
    assert any(name in message for name in NAMES.get(argument, (argument,))), message
    assert spoilt.shown is None or any(shown in message for shown in spoilt.shown.split("|")), message
    assert "\n" not in message and len(message) < 300, message


def check_result(result: Any, expected: Any) -> None:
    assert jax.tree.structure(result) == jax.tree.structure(expected)
    for leaf, good in zip(jax.tree.leaves(result), jax.tree.leaves(expected), strict=True):
        assert jnp.shape(leaf) == jnp.shape(good)
        if not isinstance(leaf, jax.ShapeDtypeStruct):
            assert np.isfinite(np.asarray(leaf, float)).all(), leaf


def test_every_public_function_has_a_row():
    """Public is what the API page lists, and what `from creps_jax import *` brings."""
    page = (Path(__file__).parents[1] / "docs/api.md").read_text()
    names = re.findall(r"automodule:: (\S+)", page)
    modules = [cj, tasks, *map(importlib.import_module, names)]
    public = {
        name for module in modules for name in module.__all__ if inspect.isfunction(getattr(module, name))
    }
    # What is said of a row, such as "of mjx", follows its name.
    rows = {name.split()[0] for name in ROWS}
    # They take no argument but for a type.
    plain = {"load_nao", "model_path", "standing"}
    assert public - plain - INNER <= rows
    assert {"Importance", "Task"} <= rows and len(names) > 20

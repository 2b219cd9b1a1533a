"""Where the algorithm meets the task: one compiled iteration, runs and trials of it, evaluation.

Every random number of a run follows from its key and the number of the iteration, so that a scan, a
loop and a resumed run draw the same ones. Rollouts are shared out over the devices.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Key, UInt32

from creps_jax import checks
from creps_jax.keys import threefry
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.rollouts import (
    Devices,
    compiled_roll_out,
    device_tuple,
    from_host,
    mean_outcome,
    replicate,
    roll_out,
    share_rows,
    spread_rows,
)
from creps_jax.search.archive import Archive, Batch
from creps_jax.search.creps import Creps, CrepsInfo, CrepsState
from creps_jax.tasks.base import Task
from creps_jax.typing import Array, Float, IntScalar, PRNGKey, Scalar, ScalarLike

__all__ = ["IterationLog", "Samples", "evaluate", "make_iteration", "train", "train_trials"]

OnIteration = Callable[[CrepsState, "IterationLog"], Any]
"""Called as (state, log) after an iteration; what it returns is not used."""


class Samples(NamedTuple):
    """The new samples of an iteration, in the order in which they were drawn (leading axis n)."""

    context: Float[Array, "n s"]
    outcome: Any
    """The task's outcomes; rewards that were not finite are the task's worst."""


class IterationLog(NamedTuple):
    """What happened in an iteration; only a reader needs it."""

    info: CrepsInfo
    mean_reward: Scalar
    """Mean reward of the new samples, failed ones included."""
    num_failed: IntScalar
    """Number of new samples whose reward was not finite and was replaced by the task's worst."""
    outcome: Any
    """Mean of each field of the task's outcome over the new samples that did not fail: of a boolean
    the fraction. NaN if all failed."""
    samples: Samples | None = None
    """The new samples; None in the logs of several iterations, which may differ in their number."""


@checks.arguments
def make_iteration(
    task: Task, algorithm: Creps, *, samples: int, devices: Devices = None
) -> Callable[[PRNGKey, CrepsState], tuple[CrepsState, IterationLog]]:
    """Make one iteration: sample contexts and parameters, roll out, archive, dual, weighted fit.

    Args:
        task: What to learn.
        algorithm: What learns it.
        samples: Number of new samples.
        devices: Devices that share the rollouts, by default all local ones. Nothing that is drawn
            depends on them.

    Returns:
        A compiled function (key, state) -> (state, log). The key is that of the whole run, the same in
        every iteration: the iteration's own is `fold_in(key, state.iteration)`. The function may be
        scanned, and vmapped over keys and states. It raises ValueError if the state does not fit
        the task.

    Raises:
        ValueError: If an argument is no task, algorithm, positive whole number or devices.

    Source: Abdolmaleki et al. 2016, Algorithm 1.
    """
    setup = _Setup(task, samples, device_tuple(devices))
    iterate = _program(algorithm, _iterate, setup)

    @checks.arguments
    def iteration(key: PRNGKey, state: CrepsState) -> tuple[CrepsState, IterationLog]:
        key, state = replicate((key, _checked_state("state", state)), setup.devices)
        return iterate(key, state)

    return iteration


@checks.arguments
def train(
    key: PRNGKey,
    task: Task,
    algorithm: Creps,
    start: LinearGaussian | CrepsState,
    *,
    iterations: int,
    samples: int,
    first_samples: int | None = None,
    on_iteration: OnIteration | None = None,
    devices: Devices = None,
) -> tuple[CrepsState, IterationLog]:
    """Run iterations of learning, from a first policy or on from a state.

    Args:
        key: Key of the run. To resume a run, give the key it began with.
        task: What to learn.
        algorithm: What learns it.
        start: The policy to begin with, or the state to go on from.
        iterations: Number of iterations to run now.
        samples: Number of new samples of each iteration.
        first_samples: Number of new samples of the very first iteration of a run, if it differs.
        on_iteration: Called on the host as (state, log) after each iteration, for progress and
            checkpoints; this log holds the samples too. Without it all iterations are one `lax.scan`, with
            the same numbers.
        devices: Devices that share the rollouts, by default all local ones.

    Returns:
        The last state, and the logs stacked along a first axis of `iterations`.

    Raises:
        ValueError: If an argument is none of what is asked for here, or state, task and features do not fit
            each other.
    """
    _check_callback(on_iteration)
    state = _checked_start(start) if isinstance(start, CrepsState) else algorithm.init(start)
    phases = _phases(task, state, iterations, samples, first_samples, devices)
    chosen = phases[0][0].devices
    key, state = replicate((key, state), chosen)
    state, logs = _run(algorithm, _iterate, phases, key, state, on_iteration)
    return state, from_host(logs, chosen)


@checks.arguments
def train_trials(
    keys: Key[Array, " trials"] | UInt32[Array, "trials _"],
    task: Task,
    algorithm: Creps,
    start: LinearGaussian | CrepsState,
    *,
    iterations: int,
    samples: int,
    first_samples: int | None = None,
    on_iteration: OnIteration | None = None,
    devices: Devices = None,
) -> tuple[CrepsState, IterationLog]:
    """Run several trials of `train` at once.

    Devices share the trials where these divide by their number, and otherwise the rollouts of all of them.

    Args:
        keys: Key of each trial.
        task: What to learn.
        algorithm: What learns it.
        start: The policy that every trial begins with, or the states (trials, ...) to go on from.
        iterations: Number of iterations to run now.
        samples: Number of new samples of each iteration of each trial.
        first_samples: Number of new samples of the very first iteration, if it differs.
        on_iteration: As in `train`; state and log have a first axis of trials.
        devices: Devices that share the work, by default all local ones. Nothing that is drawn
            depends on them.

    Returns:
        The last states (trials, ...), and the logs (trials, iterations, ...).

    Raises:
        ValueError: As in `train`, and if there is not one state for each key.
    """
    num_trials = len(checks.key("keys", keys, num_axes=1))
    _check_callback(on_iteration)
    if isinstance(start, CrepsState):
        states = _checked_start(start)
    else:
        first = algorithm.init(start)
        states = jax.tree.map(lambda x: jnp.broadcast_to(x, (num_trials, *x.shape)), first)
    if jnp.shape(states.iteration) != (num_trials,):
        raise ValueError(
            f"start must have one state for each of {num_trials} keys, got {jnp.shape(states.iteration)}"
        )
    phases = _phases(task, states, iterations, samples, first_samples, devices)
    setup = phases[0][0]
    if _shares_trials(setup, num_trials):
        keys, states = spread_rows((keys, states), setup.devices)
    else:
        keys, states = replicate((keys, states), setup.devices)
    states, logs = _run(algorithm, _iterate_trials, phases, keys, states, on_iteration)
    return states, from_host(jax.tree.map(lambda x: np.swapaxes(x, 0, 1), logs), setup.devices)


@checks.arguments
def evaluate(
    key: PRNGKey,
    task: Task,
    contexts: Float[Array, "n s"],
    thetas: Float[Array, "n d"],
    *,
    repeats: int = 1,
    devices: Devices = None,
) -> Any:
    """Roll out given parameters, such as `algorithm.mean(policy, contexts)`, with fresh seeds.

    Args:
        key: Random key; every rollout gets its own.
        task: The task.
        contexts: One context for each row of `thetas`.
        thetas: Parameters to try.
        repeats: Number of rollouts of each row.
        devices: Devices that share the rollouts, by default all local ones.

    Returns:
        The task's outcome with leading axes (n, repeats); rewards that were not finite are the
        task's worst.

    Raises:
        ValueError: If a shape does not fit the task, or `repeats` is less than 1.
    """
    num = len(contexts)
    if contexts.shape[1] != task.context_dim or thetas.shape[1] != task.theta_dim:
        raise ValueError(
            f"the task takes contexts (n, {task.context_dim}) and thetas (n, {task.theta_dim}), "
            f"got {contexts.shape} and {thetas.shape}"
        )
    chosen = device_tuple(devices)
    key, contexts, thetas = replicate((key, contexts, thetas), chosen)
    contexts, thetas = (jnp.repeat(x, repeats, axis=0) for x in (contexts, thetas))
    outcomes, _ = compiled_roll_out(task, chosen)(key, contexts, thetas)
    return jax.tree.map(lambda x: x.reshape(num, repeats, *x.shape[1:]), outcomes)


class _Setup(NamedTuple):
    """What an iteration is compiled for besides the algorithm; hashable."""

    task: Task
    samples: int
    devices: tuple[jax.Device, ...]


Iterate = Callable[[_Setup, Creps, PRNGKey, CrepsState], tuple[CrepsState, IterationLog]]


def _program(algorithm: Creps, function: Callable, *static: Any) -> Callable:
    """Return `function(*static, algorithm, key, state)`, compiled as (key, state) -> results.

    Programs live as long as the algorithms of the same settings, which share them whatever their KL bounds.
    """
    programs = algorithm.programs
    if (function, *static) not in programs:
        # A copy: the program must not keep alive the algorithm that keeps it.
        copy = algorithm.with_kl_bound(np.float32(1))

        def program(kl_bound: ScalarLike, key: Array, state: CrepsState) -> Any:
            return function(*static, copy.with_kl_bound(kl_bound), key, state)

        programs[(function, *static)] = jax.jit(program)
    kl_bound = np.float32(0) if algorithm.settings is None else algorithm.settings.kl_bound
    return partial(programs[(function, *static)], kl_bound)


def _iterate(
    setup: _Setup, algorithm: Creps, key: PRNGKey, state: CrepsState
) -> tuple[CrepsState, IterationLog]:
    task, samples, devices = setup
    _check_fit(task, state)
    # The barriers keep the compiler from fusing an iteration with what surrounds it, which rounds
    # differently in a scan and on its own.
    key, state = lax.optimization_barrier((threefry(key), state))
    context_key, theta_key, rollout_key = jax.random.split(jax.random.fold_in(key, state.iteration), 3)
    contexts = jax.vmap(partial(_sample_context, task))(jax.random.split(context_key, samples))
    thetas = algorithm.ask(theta_key, state, contexts)
    outcomes, is_failed = roll_out(task, devices, rollout_key, contexts, thetas)
    state, info = algorithm.tell(state, Batch(contexts, thetas, outcomes.reward))
    log = IterationLog(
        info=info,
        mean_reward=jnp.mean(outcomes.reward),
        num_failed=jnp.sum(is_failed, dtype=jnp.int32),
        outcome=mean_outcome(outcomes, ~is_failed),
        samples=Samples(contexts, outcomes),
    )
    return lax.optimization_barrier((state, log))


def _iterate_trials(
    setup: _Setup, algorithm: Creps, keys: Array, states: CrepsState
) -> tuple[CrepsState, IterationLog]:
    if not _shares_trials(setup, keys.shape[0]):
        return jax.vmap(partial(_iterate, setup, algorithm))(keys, states)
    alone = setup._replace(devices=setup.devices[:1])
    return share_rows(jax.vmap(partial(_iterate, alone, algorithm)), setup.devices)(keys, states)


def _sample_context(task: Task, key: PRNGKey) -> Array:
    return checks.array("what sample_context gives", task.sample_context(key), (task.context_dim,))


def _shares_trials(setup: _Setup, num_trials: int) -> bool:
    """Say whether devices share trials, which beats sharing rollouts: updates are shared as well.

    Not those of several processes: each one goes on with, and reports, all trials.
    """
    num_processes = len({device.process_index for device in setup.devices})
    return len(setup.devices) > 1 and num_processes == 1 and num_trials % len(setup.devices) == 0


def _scan(
    iterate: Iterate, setup: _Setup, length: int, algorithm: Creps, key: Array, state: CrepsState
) -> tuple[CrepsState, IterationLog]:
    def step(state: CrepsState, _: None) -> tuple[CrepsState, IterationLog]:
        state, log = iterate(setup, algorithm, key, state)
        return state, log._replace(samples=None)

    return lax.scan(step, state, length=length)


def _phases(
    task: Task,
    state: CrepsState,
    iterations: int,
    samples: int,
    first_samples: int | None,
    devices: Devices,
) -> list[tuple[_Setup, int]]:
    """List with how many samples to run how many iterations."""
    ordinary = _Setup(task, samples, device_tuple(devices))
    is_begun = np.any(np.asarray(state.iteration) > 0)
    if first_samples is None or is_begun:
        return [(ordinary, iterations)]
    phases = [(ordinary._replace(samples=first_samples), 1), (ordinary, iterations - 1)]
    return [(setup, length) for setup, length in phases if length > 0]


def _run(
    algorithm: Creps,
    iterate: Iterate,
    phases: list[tuple[_Setup, int]],
    key: Array,
    state: CrepsState,
    on_iteration: OnIteration | None,
) -> tuple[CrepsState, IterationLog]:
    """Run all phases, as scans or as loops; return the logs on the host, stacked along a first axis."""
    logs = []
    for setup, length in phases:
        if on_iteration is None and length > 1:
            scan = _program(algorithm, _scan, iterate, setup, length)
            state, log = scan(key, state)
            logs.append(jax.device_get(log))
            continue
        program = _program(algorithm, iterate, setup)
        for _ in range(length):
            state, log = program(key, state)
            logs.append(jax.tree.map(lambda x: x[None], jax.device_get(log._replace(samples=None))))
            if on_iteration is not None:
                on_iteration(state, log)
    return state, jax.tree.map(lambda *x: np.concatenate(x), *logs)


def _check_callback(on_iteration: OnIteration | None) -> None:
    if on_iteration is not None:
        checks.function("on_iteration", on_iteration, "(state, log)")


def _checked_state(name: str, state: CrepsState) -> CrepsState:
    """Return a state, its policy as arrays; whether it is of the algorithm, `ask` and `tell` will see."""
    checks.instance(name, state, CrepsState)
    checks.instance(f"{name}.policy", state.policy, LinearGaussian)
    checks.instance(f"{name}.archive", state.archive, Archive)
    fields = {field: checks.array(f"{name}.policy.{field}", x) for field, x in state.policy._asdict().items()}
    return state._replace(policy=LinearGaussian(**fields))


def _checked_start(start: CrepsState) -> CrepsState:
    start = _checked_state("start", start)
    for field, values in start.policy._asdict().items():
        checks.finite(f"start.policy.{field}", values)
    return start


def _check_fit(task: Task, state: CrepsState) -> None:
    coef, context = state.policy.coef, state.archive.batch.context
    if coef.shape[-1:] != (task.theta_dim,):
        raise ValueError(
            f"the policy must give the task's {task.theta_dim} parameters, got coef of shape {coef.shape}"
        )
    if context.shape[-1:] != (task.context_dim,):
        raise ValueError(
            f"the features must take the task's {task.context_dim} context variables, "
            f"got an archive of shape {context.shape}"
        )

"""Run a search on a task: one compiled iteration, runs, trials, evaluation.

All random numbers of an iteration follow from the key of the run and the number of the iteration: a scan, a
loop and a resumed run draw the same numbers. The devices share the rollouts.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Key, UInt32

from creps_jax import checks
from creps_jax.keys import threefry
from creps_jax.policies.learned import Learned
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
from creps_jax.search.archive import Batch
from creps_jax.search.base import Search, SearchState
from creps_jax.search.creps import Creps
from creps_jax.tasks.base import Task
from creps_jax.typing import Array, Float, IntScalar, PRNGKey, Scalar

__all__ = ["IterationLog", "Samples", "evaluate", "learned", "make_iteration", "train", "train_trials"]

OnIteration = Callable[[Any, "IterationLog"], Any]
"""Called as (state, log) after an iteration; if it returns True, the run ends there."""


class Samples(NamedTuple):
    """The new samples of an iteration, in the order in which they were drawn (leading axis n)."""

    context: Float[Array, "n s"]
    outcome: Any
    """The task's outcomes; rewards that were not finite are the task's worst."""


class IterationLog(NamedTuple):
    """The log of an iteration; the search does not use it."""

    info: Any
    """Diagnostics of the update: `CrepsInfo` for contextual REPS."""
    mean_reward: Scalar
    """Mean reward of the new samples, failed ones included."""
    num_failed: IntScalar
    """Number of new samples whose reward was not finite and was replaced by the task's worst."""
    outcome: Any
    """Mean of each field of the task's outcome over the new samples that did not fail; for a boolean field
    the fraction. NaN if all failed."""
    samples: Samples | None = None
    """The new samples; None in stacked logs, as iterations may differ in the number of samples."""


@checks.arguments
def make_iteration(
    task: Task, algorithm: Search, *, samples: int, devices: Devices = None
) -> Callable[[PRNGKey, Any], tuple[Any, IterationLog]]:
    """Make one iteration: sample contexts and parameters, roll out, archive, dual, weighted fit.

    Args:
        task: The task.
        algorithm: The search.
        samples: Number of new samples.
        devices: Devices that share the rollouts, by default all local ones. The random numbers do not depend
            on them.

    Returns:
        A compiled function (key, state) -> (state, log). The key is the key of the run, the same in all
        iterations; an iteration uses `fold_in(key, state.iteration)`. The function can be scanned, and
        vmapped over keys and states. It raises ValueError if the state does not fit the task.

    Raises:
        ValueError: If an argument has the wrong type, or `samples` is not a positive whole number.

    Source: Abdolmaleki et al. 2016, Algorithm 1.
    """
    setup = _Setup(task, samples, device_tuple(devices))
    iterate = _program(algorithm, _iterate, setup)

    @checks.arguments
    def iteration(key: PRNGKey, state: Any) -> tuple[Any, IterationLog]:
        _check_state("state", state)
        return iterate(*replicate((key, state), setup.devices))

    return iteration


@checks.arguments
def train(
    key: PRNGKey,
    task: Task,
    algorithm: Search,
    start: Any,
    *,
    iterations: int,
    samples: int,
    first_samples: int | None = None,
    on_iteration: OnIteration | None = None,
    devices: Devices = None,
) -> tuple[Any, IterationLog]:
    """Run iterations of learning, from a first policy or from the state of an earlier run.

    Args:
        key: Key of the run. To resume a run, give the same key again.
        task: The task.
        algorithm: The search.
        start: The first policy, or the state of the run to resume.
        iterations: Number of iterations to run now.
        samples: Number of new samples of each iteration.
        first_samples: Number of new samples of the first iteration of a run, if it differs.
        on_iteration: Called on the host as (state, log) after each iteration, for progress and
            checkpoints; this log also holds the samples. If it returns True, the run ends. Without it
            all iterations are one `lax.scan`, with the same numbers.
        devices: Devices that share the rollouts, by default all local ones.

    Returns:
        The last state, and the logs stacked along a first axis of `iterations`, or of fewer if
        `on_iteration` ended the run.

    Raises:
        ValueError: If an argument has the wrong type or is out of its range, or state, task and features do
            not fit each other.
    """
    _check_callback(on_iteration)
    state = start if isinstance(start, SearchState) else algorithm.init(start)
    _check_state("what init returns", state)
    algorithm.policy(state)  # Refuses the state of another search.
    setup = _Setup(task, samples, device_tuple(devices))
    key, state = replicate((key, state), setup.devices)
    loop = partial(_loop, algorithm, _iterate, key, on_iteration)
    state, logs = _run(loop, setup, state, iterations, first_samples)
    return state, from_host(logs, setup.devices)


@checks.arguments
def train_trials(
    keys: Key[Array, " trials"] | UInt32[Array, "trials _"],
    task: Task,
    algorithm: Search,
    start: Any,
    *,
    iterations: int,
    samples: int,
    first_samples: int | None = None,
    on_iteration: OnIteration | None = None,
    devices: Devices = None,
) -> tuple[Any, IterationLog]:
    """Run several trials of `train` at once.

    The devices share the trials if the number of trials is a multiple of the number of devices; otherwise
    they share the rollouts of all trials.

    Args:
        keys: Key of each trial.
        task: The task.
        algorithm: The search.
        start: The first policy of all trials, or the states (trials, ...) of the runs to resume.
        iterations: Number of iterations to run now.
        samples: Number of new samples of each iteration of each trial.
        first_samples: Number of new samples of the first iteration of a run, if it differs.
        on_iteration: As in `train`; state and log have a first axis of trials.
        devices: Devices that share the work, by default all local ones. The random numbers do not depend on
            them.

    Returns:
        The last states (trials, ...), and the logs (trials, iterations, ...).

    Raises:
        ValueError: As in `train`, and if there is not one state for each key.
    """
    num_trials = len(checks.key("keys", keys, num_axes=1))
    _check_callback(on_iteration)
    if isinstance(start, SearchState):
        if jnp.shape(start.iteration) != (num_trials,):
            raise ValueError(
                f"start must have one state for each of {num_trials} keys, got {jnp.shape(start.iteration)}"
            )
        states = start
        for trial in range(num_trials):
            algorithm.policy(jax.tree.map(lambda leaf, trial=trial: leaf[trial], states))
    else:
        first = algorithm.init(start)
        _check_state("what init returns", first)
        states = jax.tree.map(lambda x: jnp.broadcast_to(x, (num_trials, *jnp.shape(x))), first)
    setup = _Setup(task, samples, device_tuple(devices))
    if _shares_trials(setup, num_trials):
        keys, states = spread_rows((keys, states), setup.devices)
    else:
        keys, states = replicate((keys, states), setup.devices)
    loop = partial(_loop, algorithm, _iterate_trials, keys, on_iteration)
    states, logs = _run(loop, setup, states, iterations, first_samples)
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
    """Roll out given parameters, such as `algorithm.mean(policy, contexts)`, with new random numbers.

    Args:
        key: Random key; each rollout gets a key that is derived from it.
        task: The task.
        contexts: One context for each row of `thetas`.
        thetas: The parameters.
        repeats: Number of rollouts of each row.
        devices: Devices that share the rollouts, by default all local ones.

    Returns:
        The task's outcome with leading axes (n, repeats). Rewards that were not finite are replaced by the
        task's worst.

    Raises:
        ValueError: If a shape does not fit the task, or `repeats` is less than 1.
    """
    num = len(contexts)
    if contexts.shape[1] != task.context_dim or thetas.shape[1] != task.theta_dim:
        raise ValueError(
            f"contexts must be (n, {task.context_dim}) and thetas (n, {task.theta_dim}), "
            f"got {contexts.shape} and {thetas.shape}"
        )
    chosen = device_tuple(devices)
    key, contexts, thetas = replicate((key, contexts, thetas), chosen)
    contexts, thetas = (jnp.repeat(x, repeats, axis=0) for x in (contexts, thetas))
    outcomes, _ = compiled_roll_out(task, chosen)(key, contexts, thetas)
    return jax.tree.map(lambda x: x.reshape(num, repeats, *x.shape[1:]), outcomes)


@checks.arguments
def learned(
    task: Task, algorithm: Creps, state: Any, *, made_for: Mapping[str, Any] | None = None
) -> Learned:
    """Combine the policy of a state with the contexts and parameters of its task.

    The result describes itself: it returns parameters by name, in their units and bounds, and can be saved.

    Args:
        task: The task that was learned, with `contexts` and `parameters`. The tasks of this library have
            them, and `sigmoid_constrained` and `penalised` set their bounds.
        algorithm: The search, made by `creps`.
        state: The state after `train`.
        made_for: Plain values that are kept with the policy, such as name and settings of the task.

    Returns:
        The learned policy.

    Raises:
        ValueError: If the task does not state its contexts and parameters, or the policy is of another kind
            than `LinearGaussian` or `NetworkGaussian`.
    """
    if task.contexts is None or task.parameters is None:
        missing = "contexts" if task.contexts is None else "parameters"
        raise ValueError(f"the task must state its {missing}, Task(..., {missing}=Space(...)), got None")
    if algorithm.settings is None:
        raise ValueError("algorithm must be made by creps(), got one with other functions")
    made_for = {} if made_for is None else made_for
    checks.instance("made_for", made_for, Mapping)
    features = algorithm.settings.kind.features
    return Learned(algorithm.policy(state), features, task.contexts, task.parameters, made_for)


class _Setup(NamedTuple):
    """The settings for which an iteration is compiled, without the algorithm; hashable."""

    task: Task
    samples: int
    devices: tuple[jax.Device, ...]


Iterate = Callable[[_Setup, Search, PRNGKey, Any], tuple[Any, IterationLog]]


def _program(algorithm: Search, function: Callable, *static: Any) -> Callable:
    """Return `function(*static, algorithm, key, state)`, compiled as (key, state) -> results.

    A program is freed with the last of the algorithms that share it.
    """
    programs = algorithm.programs
    if (function, *static) not in programs:
        # A copy: the program must not keep alive the algorithm that keeps it.
        copy = algorithm.with_traced(algorithm.traced)

        def program(traced: Any, key: Array, state: Any) -> Any:
            return function(*static, copy.with_traced(traced), key, state)

        programs[(function, *static)] = jax.jit(program)
    return partial(programs[(function, *static)], algorithm.traced)


def _iterate(setup: _Setup, algorithm: Search, key: PRNGKey, state: Any) -> tuple[Any, IterationLog]:
    task, samples, devices = setup
    # The barriers prevent that the compiler fuses an iteration with the code around it: a scan and a single
    # iteration would round differently.
    key, state = lax.optimization_barrier((threefry(key), state))
    context_key, theta_key, rollout_key = jax.random.split(jax.random.fold_in(key, state.iteration), 3)
    contexts = jax.vmap(partial(_sample_context, task))(jax.random.split(context_key, samples))
    thetas = algorithm.ask(theta_key, state, contexts)
    if jnp.shape(thetas) != (samples, task.theta_dim):
        raise ValueError(
            f"the search must ask for the task's {task.theta_dim} parameters, "
            f"got thetas of shape {jnp.shape(thetas)}"
        )
    outcomes, is_failed = roll_out(task, devices, rollout_key, contexts, thetas)
    told = algorithm.tell(state, Batch(contexts, thetas, outcomes.reward))
    if not (isinstance(told, tuple) and len(told) == 2):
        raise ValueError(f"tell must return the new state and info, got {checks.shown(told)}")
    state, info = told
    log = IterationLog(
        info=info,
        mean_reward=jnp.mean(outcomes.reward),
        num_failed=jnp.sum(is_failed, dtype=jnp.int32),
        outcome=mean_outcome(outcomes, ~is_failed),
        samples=Samples(contexts, outcomes),
    )
    return lax.optimization_barrier((state, log))


def _iterate_trials(setup: _Setup, algorithm: Search, keys: Array, states: Any) -> tuple[Any, IterationLog]:
    if not _shares_trials(setup, keys.shape[0]):
        return jax.vmap(partial(_iterate, setup, algorithm))(keys, states)
    alone = setup._replace(devices=setup.devices[:1])
    return share_rows(jax.vmap(partial(_iterate, alone, algorithm)), setup.devices)(keys, states)


def _sample_context(task: Task, key: PRNGKey) -> Array:
    return checks.array("what sample_context gives", task.sample_context(key), (task.context_dim,))


def _shares_trials(setup: _Setup, num_trials: int) -> bool:
    """Return whether devices share trials, which is faster than sharing rollouts: they also share updates.

    Devices of several processes do not: each process needs the results of all trials.
    """
    num_processes = len({device.process_index for device in setup.devices})
    return len(setup.devices) > 1 and num_processes == 1 and num_trials % len(setup.devices) == 0


def _scan(
    iterate: Iterate, setup: _Setup, length: int, algorithm: Search, key: Array, state: Any
) -> tuple[Any, IterationLog]:
    def step(state: Any, _: None) -> tuple[Any, IterationLog]:
        state, log = iterate(setup, algorithm, key, state)
        return state, log._replace(samples=None)

    return lax.scan(step, state, length=length)


def _run(
    loop: Callable, setup: _Setup, state: Any, iterations: int, first_samples: int | None
) -> tuple[Any, IterationLog]:
    """Run iterations, the first one of a run with `first_samples`; return the last state and stacked logs."""
    if first_samples is None or np.any(np.asarray(state.iteration) > 0):
        state, logs, _ = loop(setup, iterations, state)
        return state, logs
    state, logs, is_ended = loop(setup._replace(samples=first_samples), 1, state)
    if is_ended or iterations == 1:
        return state, logs
    state, others, _ = loop(setup, iterations - 1, state)
    return state, jax.tree.map(lambda *x: np.concatenate(x), logs, others)


def _loop(
    algorithm: Search,
    iterate: Iterate,
    key: Array,
    on_iteration: OnIteration | None,
    setup: _Setup,
    length: int,
    state: Any,
) -> tuple[Any, IterationLog, bool]:
    """Run iterations of equal size, as a scan or as a loop.

    Returns:
        The last state, the logs on the host, stacked along a first axis, and whether `on_iteration` has ended
        the run.
    """
    if on_iteration is None and length > 1:
        state, log = _program(algorithm, _scan, iterate, setup, length)(key, state)
        return state, jax.device_get(log), False
    program, logs, is_ended = _program(algorithm, iterate, setup), [], False
    while len(logs) < length and not is_ended:
        state, log = program(key, state)
        logs.append(jax.device_get(log._replace(samples=None)))
        is_ended = on_iteration is not None and _is_end(on_iteration(state, log))
    return state, jax.tree.map(lambda *x: np.stack(x), *logs), is_ended


def _is_end(answer: Any) -> bool:
    """Return whether a callback has returned True, as a boolean of Python, NumPy or jax."""
    is_boolean = isinstance(answer, bool | np.bool_) or getattr(answer, "dtype", None) == np.bool_
    return is_boolean and bool(answer)


def _check_callback(on_iteration: OnIteration | None) -> None:
    if on_iteration is not None:
        checks.function("on_iteration", on_iteration, "(state, log)")


def _check_state(name: str, state: Any) -> None:
    """Check that a value is the state of a search; the functions of the search check the rest."""
    if not isinstance(state, SearchState):
        raise ValueError(
            f"{name} must be the state of a search, with a field iteration, got {checks.shown(state)}"
        )

"""Where the algorithm meets the task: one compiled iteration, runs and trials of it, evaluation.

Every random number of a run follows from its key and the number of the iteration, so that a scan, a
loop and a resumed run draw the same ones. Rollouts are shared out over the devices.
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
    """What happened in an iteration; only a reader needs it."""

    info: Any
    """What the search says of its update: `CrepsInfo` of contextual REPS."""
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
    task: Task, algorithm: Search, *, samples: int, devices: Devices = None
) -> Callable[[PRNGKey, Any], tuple[Any, IterationLog]]:
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
            checkpoints; this log holds the samples too. If it returns True, the run ends there. Without it
            all iterations are one `lax.scan`, with the same numbers.
        devices: Devices that share the rollouts, by default all local ones.

    Returns:
        The last state, and the logs stacked along a first axis of `iterations`, or of fewer if
        `on_iteration` ended the run.

    Raises:
        ValueError: If an argument is none of what is asked for here, or state, task and features do not fit
            each other.
    """
    _check_callback(on_iteration)
    state = start if isinstance(start, SearchState) else algorithm.init(start)
    _check_state("what init returns", state)
    algorithm.policy(state)  # Refuses the state of another search.
    phases = _phases(task, state, iterations, samples, first_samples, devices)
    chosen = phases[0][0].devices
    key, state = replicate((key, state), chosen)
    state, logs = _run(algorithm, _iterate, phases, key, state, on_iteration)
    return state, from_host(logs, chosen)


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


@checks.arguments
def learned(
    task: Task, algorithm: Creps, state: Any, *, made_for: Mapping[str, Any] | None = None
) -> Learned:
    """Put the policy of a state together with what the task states of contexts and parameters.

    The result describes itself: it returns parameters by name, in their units and bounds, and can be saved.

    Args:
        task: The task that was learned, with `contexts` and `parameters`. Those of this library have them,
            and `sigmoid_constrained` and `penalised` put their bounds in.
        algorithm: What learned it, made by `creps`.
        state: The state after `train`.
        made_for: Plain values to keep with the policy, such as the name of the task and its settings.

    Returns:
        The learned policy.

    Raises:
        ValueError: If the task does not state its contexts and parameters, or the policy is of another kind
            than `LinearGaussian`.
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
    """What an iteration is compiled for besides the algorithm; hashable."""

    task: Task
    samples: int
    devices: tuple[jax.Device, ...]


Iterate = Callable[[_Setup, Search, PRNGKey, Any], tuple[Any, IterationLog]]


def _program(algorithm: Search, function: Callable, *static: Any) -> Callable:
    """Return `function(*static, algorithm, key, state)`, compiled as (key, state) -> results.

    Programs live as long as the algorithms that share them.
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
    # The barriers keep the compiler from fusing an iteration with what surrounds it, which rounds
    # differently in a scan and on its own.
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
    """Say whether devices share trials, which beats sharing rollouts: updates are shared as well.

    Not those of several processes: each one goes on with, and reports, all trials.
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


def _phases(
    task: Task,
    state: Any,
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
    algorithm: Search,
    iterate: Iterate,
    phases: list[tuple[_Setup, int]],
    key: Array,
    state: Any,
    on_iteration: OnIteration | None,
) -> tuple[Any, IterationLog]:
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
            if on_iteration is not None and _is_end(on_iteration(state, log)):
                return state, jax.tree.map(lambda *x: np.concatenate(x), *logs)
    return state, jax.tree.map(lambda *x: np.concatenate(x), *logs)


def _is_end(answer: Any) -> bool:
    """Say whether a callback has returned True, as Python, NumPy or jax have it."""
    is_boolean = isinstance(answer, bool | np.bool_) or getattr(answer, "dtype", None) == np.bool_
    return is_boolean and bool(answer)


def _check_callback(on_iteration: OnIteration | None) -> None:
    if on_iteration is not None:
        checks.function("on_iteration", on_iteration, "(state, log)")


def _check_state(name: str, state: Any) -> None:
    """Refuse what is no state; whether it is one of the search, its functions will see."""
    if not isinstance(state, SearchState):
        raise ValueError(
            f"{name} must be the state of a search, with a field iteration, got {checks.shown(state)}"
        )

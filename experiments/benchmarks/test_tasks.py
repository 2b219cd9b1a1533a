"""Time whole runs of the tasks, all trials at once."""

import dataclasses
import resource

import jax
import pytest

from creps_jax.policies.features import rbf_features
from creps_jax.tasks import hole_reaching, sinus, via_point_reaching
from creps_jax.training import train_trials
from experiments import fig05_sinus, fig06_reaching, fig08_hole
from experiments.comparison import make_contender

TASKS = {
    "sinus": (sinus(), rbf_features(fig05_sinus.LOW, fig05_sinus.HIGH, 11), fig05_sinus),
    "reaching": (
        via_point_reaching(),
        rbf_features(fig06_reaching.LOW, fig06_reaching.HIGH, 2),
        fig06_reaching,
    ),
    "hole": (hole_reaching(), rbf_features(fig08_hole.LOW, fig08_hole.HIGH, 6), fig08_hole),
}


@pytest.mark.parametrize("trials", [2, 20])
@pytest.mark.parametrize("name", TASKS)
def test_whole_run(benchmark, name, trials):
    """All iterations of a figure's curve."""
    task, features, experiment = TASKS[name]
    settings = dataclasses.replace(experiment.SETTINGS["paper"], trials=trials)
    contender = make_contender(task, (features, features), settings)
    keys = jax.random.split(jax.random.key(0), trials)

    def run():
        states, _ = train_trials(
            keys,
            *contender,
            iterations=settings.iterations,
            samples=settings.samples,
            first_samples=settings.first_samples,
        )
        jax.block_until_ready(states)

    benchmark.pedantic(run, warmup_rounds=1, rounds=1)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    benchmark.extra_info["largest memory of the process, MB"] = round(peak)

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax.policies.features import linear_features, quadratic_features
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.tasks import PlainOutcome
from creps_jax.tasks.walking import WalkOutcome
from creps_jax.training import Samples
from experiments import comparison, learning
from experiments.learning import Plan, Session, learn, trial_keys
from tests.experiments.tiny import TASK

TRIALS, SAMPLES = 2, 10


@pytest.fixture
def shown(monkeypatch):
    """Collect what each run gives its progress view: the earlier rewards, then the rows."""
    views = []

    class View:
        def __init__(self, title, iterations, *, earlier, timestep, console):
            self.earlier, self.rows = earlier, []
            self.update = self.rows.append
            views.append(self)

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

    monkeypatch.setattr(learning, "Progress", View)
    return views


def test_the_view_gets_the_samples_of_all_trials_and_what_came_before(tmp_path, shown, simple_updates):
    algorithm = comparison.creps(linear_features(1), quadratic_features(1), archive_size=40)
    keys, start = trial_keys(jax.random.key(0), TRIALS), LinearGaussian(jnp.zeros((2, 1)), jnp.eye(1))
    session = Session(tmp_path, console=object())  # type: ignore[arg-type]
    devices = jax.local_devices()[:1]
    for iterations in (1, 3):
        plan = Plan(iterations, SAMPLES)
        _, log = learn(keys, TASK, algorithm, start, plan, session=session, name="tiny", devices=devices)
    first, resumed = shown
    rewards = log["mean_reward"].mean(axis=0)
    np.testing.assert_allclose(first.earlier, [])
    np.testing.assert_allclose(resumed.earlier, rewards[:1])
    for row, reward in zip(first.rows + resumed.rows, rewards, strict=True):
        assert row.samples.context.shape == row.samples.reward.shape == (TRIALS * SAMPLES,)
        assert row.samples.reward.mean() == pytest.approx(row.mean_reward, rel=1e-5)
        assert row.mean_reward == pytest.approx(reward)
        assert row.samples.speed is None and row.samples.fall_share is None
    # Samples are shown, not kept: a log has the fields that it always had.
    assert not [name for name in log if name.startswith("samples")]


def test_samples_of_walks_tell_forward_speed_and_falls():
    context = np.array([[[0.1, -5.0], [0.2, 0.0]], [[0.3, 5.0], [0.4, 5.0]]])
    speed = np.array([[[0.11, 9.0], [0.21, 9.0]], [[0.31, 9.0], [0.41, 9.0]]])
    fell = np.array([[False, True], [False, False]])
    reward = np.array([[-1.0, -2.0], [-3.0, -4.0]])
    outcome = WalkOutcome(reward, np.zeros((2, 2, 0)), fell, speed, np.ones((2, 2)))
    pooled = learning.pooled(Samples(context, outcome))
    np.testing.assert_array_equal(pooled.context, [0.1, 0.2, 0.3, 0.4])
    np.testing.assert_array_equal(pooled.reward, [-1.0, -2.0, -3.0, -4.0])
    np.testing.assert_array_equal(pooled.speed, [0.11, 0.21, 0.31, 0.41])
    np.testing.assert_array_equal(pooled.fall_share, [0.0, 1.0, 0.0, 0.0])
    plain = learning.pooled(Samples(context, PlainOutcome(reward, np.zeros((2, 2, 0)))))
    assert plain.speed is None and plain.fall_share is None

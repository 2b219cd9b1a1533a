"""The dual is Eq. 13, its minimum is SciPy's, and the weights meet their constraints whatever the rewards."""

import inspect
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import softmax

from creps_jax.search.dual import dual_objective, sample_kl, sample_weights, solve_dual
from tests.oracles import dual_scipy

NUM = 200
NUM_FEATURES = 5


TRACES = []


@jax.jit
def solve(reward, features, valid, kl_bound):
    TRACES.append(features.shape)
    solution = solve_dual(reward, features, valid, kl_bound=kl_bound)
    return solution, sample_weights(solution, reward, features, valid)


def solve_all(reward, features, kl_bound=0.5):
    """Solve with all samples valid; return the solution and its weights in float64."""
    reward, features = jnp.asarray(reward, jnp.float32), jnp.asarray(features, jnp.float32)
    solution, weights = solve(reward, features, jnp.ones(reward.shape, bool), jnp.float32(kl_bound))
    return solution, np.asarray(weights, np.float64)


def radial(context, num_centers=NUM_FEATURES, width=None):
    centers = np.linspace(0, 1, num_centers)
    return softmax(-0.5 * ((context[:, None] - centers) / (width or 1 / num_centers)) ** 2, axis=1)


def samples(seed=0):
    """Return contexts, their features, and rewards as in the sinus task."""
    rng = np.random.default_rng(seed)
    context = rng.uniform(size=NUM)
    reward = -((rng.normal(size=NUM) - np.sin(6 * context)) ** 2)
    return context, radial(context), reward


def mismatch(weights, features):
    """Return the largest change of a feature's mean, in standard deviations of that feature."""
    features = np.asarray(np.float32(features), np.float64)
    return np.max(np.abs(weights @ (features - features.mean(0))) / features.std(0))


def assert_meets_constraints(solution, weights, features, kl_bound):
    assert bool(solution.is_active)
    assert dual_scipy.kl_to_uniform(weights) == pytest.approx(kl_bound, rel=1e-3)
    assert mismatch(weights, features) < 1e-4
    assert float(solution.grad_norm) < 3e-4


def assert_finite(*trees):
    for leaf in jax.tree.leaves(trees):
        assert np.all(np.isfinite(leaf))


# The function.


def test_objective_is_equation_13_in_float64():
    _, features, reward = samples()
    rng = np.random.default_rng(1)
    for log_temperature in (-1.0, 0.0, 2.0):
        coef = rng.normal(size=NUM_FEATURES)
        value = dual_objective(
            jnp.float32(log_temperature),
            jnp.float32(coef),
            jnp.float32(reward),
            jnp.float32(features),
            jnp.ones(NUM, bool),
            0.5,
        )
        expected = dual_scipy.objective(np.exp(log_temperature), coef, reward, features, 0.5)
        np.testing.assert_allclose(value, expected, rtol=1e-5, atol=1e-5)


def test_objective_is_convex_on_chords():
    _, features, reward = samples()
    rng = np.random.default_rng(2)
    ends = rng.normal(size=(2, 500, 1 + NUM_FEATURES)) * 2
    ends[..., 0] = np.exp(ends[..., 0])  # the temperature, in which (not in its logarithm) it is convex
    evaluate = jax.jit(
        jax.vmap(
            lambda point: dual_objective(
                jnp.log(point[0]),
                point[1:],
                jnp.float32(reward),
                jnp.float32(features),
                jnp.ones(NUM, bool),
                0.5,
            )
        )
    )
    share = rng.uniform(size=(500, 1))
    middle = share * ends[0] + (1 - share) * ends[1]
    left, right, between = (np.asarray(evaluate(jnp.float32(p)), np.float64) for p in (*ends, middle))
    chord = share[:, 0] * left + (1 - share[:, 0]) * right
    assert np.all(between <= chord + 1e-5 * (1 + np.abs(chord)))


def test_objective_is_flat_along_constants_that_features_span():
    _, features, reward = samples()
    args = (jnp.float32(reward), jnp.float32(features), jnp.ones(NUM, bool), 0.5)
    coef = jnp.linspace(-1.0, 1.0, NUM_FEATURES)
    np.testing.assert_allclose(
        dual_objective(0.3, coef, *args), dual_objective(0.3, coef + 7.0, *args), atol=1e-5
    )


# The minimum.


@pytest.mark.parametrize("kl_bound", [0.001, 0.1, 0.5, 1.5, 2.5])
def test_minimum_is_that_of_scipy(kl_bound):
    _, features, reward = samples()
    solution, weights = solve_all(reward, features, kl_bound)
    temperature, _, expected = dual_scipy.solve(np.float32(reward), np.float32(features), kl_bound)
    assert float(solution.temperature) == pytest.approx(temperature, rel=1e-3)
    np.testing.assert_allclose(weights, expected, rtol=2e-3, atol=1e-7)
    assert_meets_constraints(solution, weights, features, kl_bound)


def falls(rng, num_falls, depth):
    """Return rewards of a task well done, around -0.01, but for a few samples far below."""
    reward = -10 * rng.normal(scale=0.03, size=NUM) ** 2
    reward[rng.permutation(NUM)[:num_falls]] -= depth
    return reward


EXTREME = {
    "one fall": lambda rng: falls(rng, 1, 100),
    "twenty falls": lambda rng: falls(rng, 20, 100),
    "half falls": lambda rng: falls(rng, NUM // 2, 100),
    "nearly all falls": lambda rng: falls(rng, NUM - 10, 100),
    "one very deep fall": lambda rng: falls(rng, 1, 1e6),
    "many very deep falls": lambda rng: falls(rng, 60, 1e6),
    "two values": lambda rng: np.where(rng.uniform(size=NUM) < 0.3, 1.0, 0.0),
    "three values": lambda rng: rng.choice([0.0, -1.0, -100.0], size=NUM, p=[0.2, 0.5, 0.3]),
    "long tail below": lambda rng: -(np.abs(rng.standard_cauchy(NUM)) ** 3),
    "long tail above": lambda rng: np.abs(rng.standard_cauchy(NUM)) ** 3,
    "many magnitudes": lambda rng: -np.exp(5 * rng.normal(size=NUM)),
}


@pytest.mark.parametrize("name", EXTREME)
def test_constraints_hold_for_extreme_rewards(name):
    _, features, _ = samples()
    reward = np.float32(EXTREME[name](np.random.default_rng(3)))
    solution, weights = solve_all(reward, features)
    assert_meets_constraints(solution, weights, features, 0.5)
    temperature, _, expected = dual_scipy.solve(reward, np.float32(features), 0.5)
    assert float(solution.temperature) == pytest.approx(temperature, rel=2e-3)
    np.testing.assert_allclose(weights, expected, rtol=5e-3, atol=1e-6)


def test_bound_beyond_nearly_tied_best_rewards_is_reached():
    _, features, _ = samples()
    rng = np.random.default_rng(4)
    # Sixty good samples differ by 1e-5 of what parts them from the others, and the bound tells them apart.
    reward = np.where(np.arange(NUM) < 60, -1e-5 * rng.uniform(size=NUM), -1.0 - rng.uniform(size=NUM))
    solution, weights = solve_all(reward, features, 1.6)
    assert_meets_constraints(solution, weights, features, 1.6)


@pytest.mark.parametrize("scale", [1.0, 100.0, 1000.0])
def test_constraints_hold_where_the_context_decides_the_reward(scale):
    context, features, reward = samples()
    solution, weights = solve_all(reward - scale * np.sin(3 * context), features)
    assert_meets_constraints(solution, weights, features, 0.5)


@pytest.mark.parametrize(
    "make",
    [
        lambda s: np.column_stack([s, 2 * s, s**2, 3 * s + 1, s - s**2]),
        lambda s: np.column_stack([1e-6 * s, 1e6 * s**2, s**3, 1e3 + s, np.sin(9 * s)]),
        lambda s: np.column_stack([s, s**2, s**3, s**4, s**5]),
        lambda s: radial(s, NUM_FEATURES, 0.6),
    ],
    ids=["collinear", "scales and offsets", "monomials", "wide radial"],
)
def test_constraints_hold_for_awkward_features(make):
    context, _, reward = samples()
    features = make(context)
    solution, weights = solve_all(reward, features)
    assert_meets_constraints(solution, weights, features, 0.5)


def test_constraints_hold_for_twenty_wide_radial_features():
    context, _, reward = samples()
    features = radial(context, 20, 0.3)
    solution, weights = solve_all(reward, features)
    assert_meets_constraints(solution, weights, features, 0.5)


# Invariances.


@pytest.mark.parametrize("scale", [1e-30, 1e-9, 3.0, 1e9, 1e30])
def test_scaling_rewards_scales_the_solution_and_keeps_the_weights(scale):
    _, features, reward = samples()
    plain, weights = solve_all(reward, features)
    scaled, scaled_weights = solve_all(reward * scale, features)
    np.testing.assert_allclose(scaled.temperature, scale * plain.temperature, rtol=1e-4)
    np.testing.assert_allclose(
        features @ scaled.baseline_coef / scale, features @ plain.baseline_coef, atol=1e-3
    )
    np.testing.assert_allclose(scaled_weights, weights, rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize("shift", [-1e6, 1e3, 1e6])
def test_shifting_rewards_keeps_the_weights(shift):
    _, features, reward = samples()
    shifted = np.float32(np.float32(reward) + np.float32(shift))
    # What the shift leaves of the rewards, after their rounding, without the shift.
    rounded = np.float64(shifted) - np.float64(np.float32(shift))
    solution, weights = solve_all(shifted, features)
    expected_solution, expected = solve_all(rounded, features)
    np.testing.assert_allclose(solution.temperature, expected_solution.temperature, rtol=1e-4)
    np.testing.assert_allclose(weights, expected, rtol=1e-3, atol=1e-7)


def test_mask_equals_subset():
    _, features, reward = samples()
    valid = np.random.default_rng(5).uniform(size=NUM) < 0.5
    reward, features = jnp.float32(reward), jnp.float32(features)
    masked, weights = solve(reward, features, jnp.asarray(valid), jnp.float32(0.5))
    subset, expected = solve_all(reward[valid], features[valid])
    np.testing.assert_allclose(masked.temperature, subset.temperature, rtol=1e-4)
    np.testing.assert_allclose(weights[valid], expected, rtol=1e-3, atol=1e-7)
    assert np.all(weights[~valid] == 0)


def test_traced_once():
    _, features, reward = samples()
    solve_all(reward, features)
    num_traces = len(TRACES)
    solve_all(100 * reward, features, 0.1)
    assert len(TRACES) == num_traces


# What cannot be solved.


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kl_bound", [5.0, 50.0, 1e8])
def test_bound_out_of_reach_gives_nearly_greedy_weights_that_keep_the_features(kl_bound, seed):
    _, features, reward = samples(seed)
    solution, weights = solve_all(reward, features, kl_bound)
    assert_finite(solution, weights)
    assert not bool(solution.is_active)
    assert float(solution.temperature) > 0
    assert float(solution.grad_norm) < 3e-4
    assert mismatch(weights, features) < 1e-4
    # The greedy weights put everything on as few samples as can keep the mean of four free features.
    assert 1 / np.sum(weights**2) < NUM_FEATURES + 1


def test_constant_features_leave_the_best_sample_to_greed():
    _, _, reward = samples()
    solution, weights = solve_all(reward, np.ones((NUM, NUM_FEATURES)), 50.0)
    assert not bool(solution.is_active)
    assert weights.argmax() == reward.argmax()
    assert weights.max() > 0.9


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("num_valid", [0, 1, 2, 3, 7, 30])
def test_few_valid_samples_give_finite_answers(num_valid, seed):
    _, features, reward = samples(seed)
    valid = jnp.arange(NUM) < num_valid
    solution, weights = solve(jnp.float32(reward), jnp.float32(features), valid, jnp.float32(0.5))
    assert_finite(solution, weights)
    assert float(solution.temperature) > 0
    np.testing.assert_allclose(np.sum(weights), float(num_valid > 0), atol=1e-5)
    assert np.all(np.asarray(weights)[num_valid:] == 0)
    # With fewer samples than features rounding has a say in which means can be kept.
    assert float(solution.grad_norm) < (1e-3 if num_valid > NUM_FEATURES else 2e-2)


def test_more_features_than_samples_give_finite_answers():
    context, _, reward = samples()
    features = radial(context, 20)
    solution, weights = solve_all(reward[:12], features[:12])
    assert_finite(solution, weights)
    np.testing.assert_allclose(weights.sum(), 1, atol=1e-5)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_samples_that_are_not_finite_do_not_count(bad):
    _, features, reward = samples()
    reward, features, valid = np.float32(reward), np.float32(features), np.arange(NUM) % 2 == 0
    expected, expected_weights = solve(
        jnp.asarray(reward), jnp.asarray(features), jnp.asarray(valid), jnp.float32(0.5)
    )
    hidden_reward, hidden_features = reward.copy(), features.copy()
    hidden_reward[1::4] = bad
    hidden_features[3::4] = bad
    for mask in (valid, np.ones(NUM, bool)):
        solution, weights = solve(
            jnp.asarray(hidden_reward), jnp.asarray(hidden_features), jnp.asarray(mask), jnp.float32(0.5)
        )
        np.testing.assert_array_equal(solution.temperature, expected.temperature)
        np.testing.assert_array_equal(weights, expected_weights)


def test_no_finite_sample_gives_zero_weights():
    _, features, _ = samples()
    solution, weights = solve_all(np.full(NUM, np.nan), features)
    assert_finite(solution)
    assert np.all(weights == 0)


def test_gradients_do_not_see_masked_samples():
    _, features, reward = samples()
    valid = jnp.arange(NUM) % 2 == 0
    reward = jnp.where(valid, jnp.float32(reward), jnp.nan)
    features = jnp.where(valid[:, None], jnp.float32(features), jnp.nan)
    solution, _ = solve(reward, features, valid, jnp.float32(0.5))
    coef = solution.baseline_coef
    objective = partial(dual_objective, valid=valid, kl_bound=0.5)
    by_all = jax.jit(jax.grad(objective, (0, 1, 2, 3)))(jnp.log(solution.temperature), coef, reward, features)
    first_weight = jax.jit(jax.grad(lambda *args: sample_weights(solution, *args, valid)[0], (0, 1)))
    by_weights = first_weight(reward, features)
    assert_finite(by_all, by_weights)
    # By the envelope theorem the derivative by the rewards is the weights.
    np.testing.assert_allclose(by_all[2], sample_weights(solution, reward, features, valid), atol=1e-6)


# The relative entropy.


def test_sample_kl_is_that_of_float64():
    rng = np.random.default_rng(6)
    for spread in (1e-3, 1.0, 10.0):
        weights = softmax(spread * rng.normal(size=NUM))
        expected = dual_scipy.kl_to_uniform(np.float64(np.float32(weights)))
        np.testing.assert_allclose(sample_kl(jnp.float32(weights)), expected, rtol=2e-3)


def test_sample_kl_lies_between_zero_and_the_logarithm_of_the_count():
    valid = jnp.arange(NUM) < 10
    uniform = jnp.where(valid, 0.1, 0.0)
    single = jnp.zeros(NUM).at[3].set(1.0)
    np.testing.assert_allclose(sample_kl(uniform, valid), 0.0, atol=1e-7)
    np.testing.assert_allclose(sample_kl(single, valid), np.log(10), rtol=1e-6)
    assert float(sample_kl(jnp.zeros(NUM), jnp.zeros(NUM, bool))) == 0.0


# Errors.


@pytest.mark.parametrize("kl_bound", [0.0, -1.0, np.nan, np.inf])
def test_bad_bound_is_named(kl_bound):
    with pytest.raises(ValueError, match=f"kl_bound must be finite and above 0, got {kl_bound}"):
        solve_dual(jnp.zeros(3), jnp.zeros((3, 2)), kl_bound=kl_bound)


@pytest.mark.parametrize(
    ("reward", "features", "valid", "message"),
    [
        ((3,), (4, 2), (3,), r"got shapes \(3,\) and \(4, 2\)"),
        ((3, 1), (3, 2), (3,), r"got shapes \(3, 1\) and \(3, 2\)"),
        ((3,), (3,), (3,), r"got shapes \(3,\) and \(3,\)"),
        ((3,), (3, 0), (3,), r"got shapes \(3,\) and \(3, 0\)"),
        ((3,), (3, 2), (4,), r"valid must have shape \(3,\), got \(4,\)"),
    ],
)
def test_bad_shapes_are_named(reward, features, valid, message):
    # Below the type checker of the tests, as a user meets it.
    unchecked = inspect.unwrap(solve_dual)
    with pytest.raises(ValueError, match=message):
        unchecked(jnp.zeros(reward), jnp.zeros(features), jnp.ones(valid, bool), kl_bound=0.5)


def test_a_prior_counts_a_sample_as_often_as_copies_of_it(key):
    """In the solution, its quality and the weights; the scale of the prior does not matter."""
    reward_key, feature_key, count_key = jax.random.split(key, 3)
    reward = jax.random.normal(reward_key, (NUM,))
    features = jax.random.normal(feature_key, (NUM, 3))
    copies = jax.random.randint(count_key, (NUM,), 0, 4)
    index = np.repeat(np.arange(NUM), copies)
    solution = solve_dual(reward, features, 0.01 * copies.astype(jnp.float32), kl_bound=0.5)
    expected = solve_dual(reward[index], features[index], kl_bound=0.5)
    np.testing.assert_allclose(solution.temperature, expected.temperature, rtol=1e-4)
    weights = sample_weights(solution, reward, features, copies.astype(jnp.float32))
    summed = np.bincount(index, sample_weights(expected, reward[index], features[index]), minlength=NUM)
    np.testing.assert_allclose(weights, summed, rtol=1e-3, atol=1e-6)
    assert solution.grad_norm < 1e-4
    np.testing.assert_allclose(sample_kl(weights, copies.astype(jnp.float32)), 0.5, rtol=1e-3)


@pytest.mark.parametrize("small", [1e-10, 1e-20, 1e-37])
@pytest.mark.parametrize("gap", [1.0, 10.0, 100.0])
def test_a_small_prior_with_a_large_reward_breaks_nothing(key, small, gap):
    reward = jax.random.normal(key, (NUM,)).at[0].set(gap)
    features = jax.random.normal(jax.random.fold_in(key, 1), (NUM, 2))
    prior = jnp.ones(NUM).at[0].set(small)
    solution = solve_dual(reward, features, prior, kl_bound=0.5)
    weights = sample_weights(solution, reward, features, prior)
    np.testing.assert_allclose(sample_kl(weights, prior), 0.5, rtol=1e-3)
    assert solution.is_active and solution.grad_norm < 1e-3
    variables = jnp.zeros(3)
    hessian = jax.hessian(lambda x: dual_objective(x[0], x[1:], reward, features, prior, 0.5))(variables)
    assert jnp.isfinite(hessian).all()


@pytest.mark.usefixtures("compiled_as_for_users")
def test_vmap_equals_loop():
    batches = [samples(seed) for seed in range(4)]
    reward = jnp.stack([jnp.float32(batch[2]) for batch in batches])
    features = jnp.stack([jnp.float32(batch[1]) for batch in batches])
    valid = jnp.ones(reward.shape, bool)
    bounds = jnp.float32([0.1, 0.5, 1.0, 50.0])
    solutions, weights = jax.jit(jax.vmap(solve))(reward, features, valid, bounds)
    for i in range(4):
        alone, alone_weights = solve(reward[i], features[i], valid[i], bounds[i])
        assert bool(solutions.is_active[i]) == bool(alone.is_active) == (i < 3)
        rounding = 1e-3 if i < 3 else 0.1  # of the relative entropy of greedy weights, which sets the last
        np.testing.assert_allclose(solutions.temperature[i], alone.temperature, rtol=rounding)
        np.testing.assert_allclose(weights[i], alone_weights, atol=rounding / 10)


# Differences of rewards.


@pytest.mark.parametrize("convert", [np.asarray, list], ids=["array", "list"])
@pytest.mark.parametrize("offset", [-1e9, 1e3, 1e6, 1e7, 1e8, 1e9])
def test_an_offset_of_float64_rewards_changes_no_weight(offset, convert):
    _, features, reward = samples()
    features = jnp.float32(features)
    expected = sample_weights(solve_dual(reward, features, kl_bound=0.5), reward, features)
    given = convert(reward + offset)
    solution = solve_dual(given, features, kl_bound=0.5)
    weights = sample_weights(solution, given, features)
    assert bool(solution.is_informative) and bool(solution.is_active)
    np.testing.assert_allclose(weights, expected, rtol=1e-3, atol=1e-9)


def test_an_offset_of_whole_rewards_changes_no_weight():
    _, features, _ = samples()
    features, reward = jnp.float32(features), np.random.default_rng(8).integers(0, 20, NUM)
    weights = [
        sample_weights(solve_dual(given, features, kl_bound=0.5), given, features)
        for given in (reward.astype(np.float32), reward + 2**40, (reward - 2**40).tolist())
    ]
    for shifted in weights[1:]:
        np.testing.assert_allclose(shifted, weights[0], rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("bad", [1e30, 1e300, np.inf, np.nan])
def test_samples_that_do_not_count_take_no_digits_of_the_others(bad):
    _, features, reward = samples()
    features, valid = jnp.float32(features), np.arange(NUM) > 0
    expected = sample_weights(solve_dual(reward, features, valid, kl_bound=0.5), reward, features, valid)
    hidden = np.where(valid, reward + 1e8, bad)
    solution = solve_dual(hidden, features, valid, kl_bound=0.5)
    np.testing.assert_allclose(
        sample_weights(solution, hidden, features, valid), expected, rtol=1e-3, atol=1e-9
    )


def span(kind, context, num_features):
    """Return features that may be wide, nearly collinear, or on an offset."""
    if kind == "monomials":
        return np.column_stack([context ** (i + 1) for i in range(num_features)])
    if kind == "offset":
        return np.column_stack([1e3 + context, *(np.sin(3 * i * context) for i in range(1, num_features))])
    return radial(context, num_features, {"radial": None, "wide radial": 0.3}[kind])


@pytest.mark.parametrize("kind", ["radial", "wide radial", "monomials", "offset"])
@pytest.mark.parametrize("offset", [0.0, 1e2, 1e5])
@pytest.mark.parametrize("num_features", [2, 6, 11])
def test_rewards_that_the_baseline_explains_leave_the_prior(kind, offset, num_features):
    rng = np.random.default_rng(9)
    features = np.float32(span(kind, rng.uniform(size=NUM), num_features))
    reward = features @ np.float32(rng.normal(size=num_features) + offset)
    assert_gives_the_prior(reward, features)


@pytest.mark.parametrize("kind", ["radial", "wide radial", "monomials"])
@pytest.mark.parametrize("size", [1e-5, 1e-3, 0.1])
@pytest.mark.parametrize("num_features", [2, 6, 11])
def test_a_little_that_the_baseline_does_not_explain_counts(kind, size, num_features):
    rng = np.random.default_rng(9)
    features = np.float32(span(kind, rng.uniform(size=NUM), num_features))
    reward = features @ np.float32(rng.normal(size=num_features)) + size * rng.normal(size=NUM)
    assert bool(solve_dual(jnp.float32(reward), jnp.asarray(features), kl_bound=0.5).is_informative)


def assert_gives_the_prior(reward, features, valid=None, **settings):
    reward, features = jnp.asarray(reward, jnp.float32), jnp.asarray(features, jnp.float32)
    valid = jnp.ones(reward.shape, bool) if valid is None else jnp.asarray(valid)
    solution = solve_dual(reward, features, valid, **({"kl_bound": 0.5} | settings))
    weights = sample_weights(solution, reward, features, valid)
    assert_finite(solution, weights)
    assert not bool(solution.is_informative) and not bool(solution.is_active)
    assert float(solution.temperature) > 0 and float(sample_kl(weights, valid)) == 0.0
    assert np.unique(np.asarray(weights)[np.asarray(valid)]).size == 1
    assert float(solution.grad_norm) < 1e-6


@pytest.mark.parametrize("value", [0.0, 3.0, -1e9, 1e-9, 3e38, 1e-40])
def test_equal_rewards_leave_the_prior(value):
    assert_gives_the_prior(np.full(NUM, value), samples()[1], np.arange(NUM) % 3 > 0)


@pytest.mark.parametrize("num_valid", range(1, NUM_FEATURES + 1))
def test_as_few_samples_as_features_leave_the_prior(num_valid):
    _, features, reward = samples()
    assert_gives_the_prior(reward, features, np.arange(NUM) < num_valid)


def test_a_prior_is_returned_as_it_is():
    features, prior = jnp.float32(samples()[1]), jnp.linspace(0.0, 3.0, NUM)
    solution = solve_dual(jnp.full(NUM, 7.0), features, prior, kl_bound=0.5)
    weights = sample_weights(solution, jnp.full(NUM, 7.0), features, prior)
    np.testing.assert_allclose(weights, prior / prior.sum(), rtol=1e-6)
    assert float(sample_kl(weights, prior)) == 0.0


@pytest.mark.parametrize(
    ("offset", "is_informative"),
    [(0.0, True), (1e3, True), (1e6, True), (-1e7, True), (1e7, True), (1e8, False), (1e9, False)],
)
def test_small_differences_count_until_the_format_loses_them(offset, is_informative):
    _, features, _ = samples()
    reward = np.float32(offset + np.random.default_rng(10).normal(size=NUM))
    solution, weights = solve_all(reward, features)
    assert bool(solution.is_informative) == bool(solution.is_active) == is_informative
    assert dual_scipy.kl_to_uniform(weights) == pytest.approx(0.5 * is_informative, rel=1e-3, abs=1e-6)


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_the_caller_knows_which_differences_are_rounding(scale):
    _, features, reward = samples()
    spread = scale * np.ptp(reward)
    solution = solve_dual(
        jnp.float32(scale * reward), jnp.float32(features), kl_bound=0.5, resolution=1e-3 * spread
    )
    assert bool(solution.is_informative)
    assert_gives_the_prior(scale * reward, features, resolution=spread)


@pytest.mark.parametrize("resolution", [-1.0, np.nan, np.inf])
def test_bad_resolution_is_named(resolution):
    with pytest.raises(ValueError, match=f"resolution must be finite and at least 0, got {resolution}"):
        solve_dual(jnp.zeros(3), jnp.zeros((3, 2)), kl_bound=0.5, resolution=resolution)


@pytest.mark.parametrize("bound", [0.0, -0.0, -1.0, np.nan, -np.inf, 1e-42])
def test_a_traced_bound_that_is_no_positive_number_leaves_the_prior(bound):
    _, features, reward = samples()
    solution, weights = solve_all(reward, features, bound)
    assert_finite(solution, weights)
    assert float(solution.temperature) > 0 and not bool(solution.is_active)
    assert np.unique(weights).size == 1 and float(sample_kl(jnp.float32(weights))) == 0.0


# Double precision.


@pytest.mark.parametrize(
    ("reward_dtype", "feature_dtype", "valid_dtype"),
    [
        (np.float32, np.float64, bool),
        (np.float64, np.float32, np.float32),
        (np.float32, np.float32, np.float64),
        (np.float64, np.float64, np.float32),
        (np.float32, np.float64, np.float64),
    ],
)
def test_formats_may_be_mixed(reward_dtype, feature_dtype, valid_dtype):
    _, features, reward = samples()
    with jax.enable_x64(True):
        given = jnp.asarray(reward, reward_dtype), jnp.asarray(features, feature_dtype)
        valid = jnp.ones(NUM, valid_dtype)
        bounds = 0.5, np.float64(0.5), jnp.float32(0.5), jnp.float64(0.5)
        solutions = [solve_dual(*given, valid, kl_bound=bound) for bound in bounds]
        for solution in solutions:
            assert solution.temperature.dtype == max(reward_dtype, feature_dtype, key=lambda x: x(0).itemsize)
            weights = sample_weights(solution, *given, valid)
            np.testing.assert_allclose(sample_kl(weights, valid), 0.5, rtol=1e-4)


@pytest.mark.parametrize("kl_bound", [1e-6, 0.5, 2.0])
def test_minimum_in_float64_is_that_of_scipy(kl_bound):
    _, features, reward = samples()
    temperature, _, expected = dual_scipy.solve(reward, features, kl_bound)
    with jax.enable_x64(True):
        given = jnp.float64(reward), jnp.float64(features)
        solution = solve_dual(*given, kl_bound=kl_bound)
        weights = np.asarray(sample_weights(solution, *given))
    assert float(solution.temperature) == pytest.approx(temperature, rel=1e-5)
    np.testing.assert_allclose(weights, expected, rtol=1e-4)
    assert dual_scipy.kl_to_uniform(weights) == pytest.approx(kl_bound, rel=1e-8)
    assert float(solution.grad_norm) < 1e-12


@pytest.mark.parametrize("name", EXTREME)
def test_constraints_hold_for_extreme_rewards_in_float64(name):
    _, features, _ = samples()
    reward = EXTREME[name](np.random.default_rng(3))
    with jax.enable_x64(True):
        solution, weights = solve(
            jnp.float64(reward), jnp.float64(features), jnp.ones(NUM, bool), jnp.float64(0.5)
        )
    assert bool(solution.is_active)
    assert dual_scipy.kl_to_uniform(np.asarray(weights)) == pytest.approx(0.5, rel=1e-6)
    assert float(solution.grad_norm) < 1e-6


# Numbers of any size.


def solve_eagerly_and_compiled(reward, features, valid):
    """Return both answers, after checking that they are finite and say the same."""
    reward, features, valid = (jnp.asarray(x, jnp.float32) for x in (reward, features, valid))
    solution = solve_dual(reward, features, valid, kl_bound=0.5)
    eager = solution, sample_weights(solution, reward, features, valid)
    compiled = solve(reward, features, valid, jnp.float32(0.5))
    for solution, weights in (eager, compiled):
        assert_finite(solution, weights)
        assert float(solution.temperature) > 0
        np.testing.assert_allclose(np.sum(np.asarray(weights, np.float64)), 1.0, atol=1e-5)
        assert float(sample_kl(weights, valid)) < 0.5 * (1 + 1e-3)
    np.testing.assert_allclose(eager[0].temperature, compiled[0].temperature, rtol=1e-4)
    np.testing.assert_allclose(eager[1], compiled[1], rtol=1e-3, atol=1e-7)
    return compiled


@pytest.mark.usefixtures("compiled_as_for_users")
@pytest.mark.parametrize("scale", [3.4e38, 9e37, 1e37, 1e-30, 1e-37, 1e-38, 1e-40, 1e-43, 1.4e-45])
@pytest.mark.parametrize("is_uniform", [True, False])
def test_only_the_ratios_of_a_prior_matter(scale, is_uniform):
    _, features, reward = samples()
    ratio = np.ones(NUM) if is_uniform else np.random.default_rng(7).choice([1.0, 0.5, 0.0], size=NUM)
    # What the format makes of small ones.
    prior = np.float32(ratio) * np.float32(scale)
    assert prior.any()
    solution, weights = solve_eagerly_and_compiled(reward, features, prior)
    expected, expected_weights = solve_eagerly_and_compiled(
        reward, features, np.float64(prior) / np.float64(prior.max())
    )
    np.testing.assert_allclose(solution.temperature, expected.temperature, rtol=1e-4)
    np.testing.assert_allclose(weights, expected_weights, rtol=1e-3, atol=1e-7)
    assert np.all((np.asarray(weights) > 0) == (prior > 0))


HUGE = {
    "both ends": lambda reward: np.where(np.arange(NUM) % 2, 3e38, -3e38),
    "all large": lambda reward: 1e37 * reward,
    "all at the end": lambda reward: np.full(NUM, 3.4e38),
    "one up": lambda reward: np.where(np.arange(NUM) == 3, 1e38, reward),
    "one down": lambda reward: np.where(np.arange(NUM) == 3, -3.4e38, reward),
    "one each way": lambda reward: np.where(np.arange(NUM) < 2, [3.4e38, -3.4e38] * (NUM // 2), reward),
    "all magnitudes": lambda reward: np.sign(reward + 1) * 10.0 ** np.linspace(-38, 38, NUM),
    "ordinary": lambda reward: reward,
    "tiny": lambda reward: 1e-30 * reward,
}
UNITS = {
    "one": np.ones(NUM_FEATURES),
    "large": np.full(NUM_FEATURES, 1e30),
    "tiny": np.full(NUM_FEATURES, 1e-30),
    "at the ends": np.array([3e38, 1e-37, 1.0, 1e38, 1e-38]),
    "mixed": np.array([1e30, 1e-30, 1.0, 1e15, 1e-15]),
}


@pytest.mark.usefixtures("compiled_as_for_users")
@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("name", HUGE)
def test_what_is_finite_has_a_finite_answer(name, unit):
    _, features, reward = samples()
    solve_eagerly_and_compiled(HUGE[name](reward), features * UNITS[unit], np.ones(NUM))


@pytest.mark.parametrize("exponent", [-90, 90])
def test_units_of_features_change_no_weight(exponent):
    _, features, reward = samples()
    features, units = np.float32(features), 2.0 ** (exponent * np.array([1, -1, 0, 1, 0]))
    solution, weights = solve_all(reward, features * units)
    expected, expected_weights = solve_all(reward, features)
    np.testing.assert_array_equal(weights, expected_weights)
    np.testing.assert_array_equal(solution.baseline_coef * np.float32(units), expected.baseline_coef)

"""The dual function of contextual REPS (Abdolmaleki et al. 2016, Eq. 13) in float64, minimised by SciPy."""

import numpy as np
from scipy.optimize import minimize
from scipy.special import logsumexp


def objective(temperature, coef, reward, features, kl_bound):
    """Return g(eta, w) as printed in Eq. 13."""
    advantage = (reward - features @ coef) / temperature
    log_mean = logsumexp(advantage) - np.log(reward.size)
    return temperature * kl_bound + features.mean(0) @ coef + temperature * log_mean


def weights_of(temperature, coef, reward, features):
    """Return the weights exp((R - V) / eta), normalised."""
    advantage = (reward - features @ coef) / temperature
    return np.exp(advantage - logsumexp(advantage))


def kl_to_uniform(weights):
    """Return sum d log(n d)."""
    positive = weights[weights > 0]
    return float(np.sum(positive * np.log(positive * weights.size)))


def solve(reward, features, kl_bound):
    """Minimise the dual function by L-BFGS-B and then trust-exact; return (temperature, coef, weights).

    Works with features of mean zero and mean square one, and with rewards in units of the temperature: each
    pass takes the temperature of the last one as its unit, until it stays.
    """
    reward, features = np.asarray(reward, np.float64), np.asarray(features, np.float64)
    reward = reward - reward.max()
    _, singular, axes = np.linalg.svd(features - features.mean(0), full_matrices=False)
    is_spread = singular > 1e-6 * singular.max()  # the rest is rounding of features given in float32
    matrix = axes[is_spread].T / singular[is_spread] * np.sqrt(reward.size)
    white = (features - features.mean(0)) @ matrix
    unit, coef = reward.std(), np.zeros(white.shape[1])
    for _ in range(60):
        args = ((reward - white @ coef) / unit, white, kl_bound)
        start = np.zeros(1 + coef.size)
        bounds = [(-1.5, 1.5)] + [(None, None)] * coef.size
        found = minimize(_value, start, args, "L-BFGS-B", jac=_gradient, bounds=bounds).x
        if abs(found[0]) < 1.0:
            options = {"gtol": 1e-12, "initial_trust_radius": 0.1}
            found = minimize(
                _value, found, args, "trust-exact", jac=_gradient, hess=_hessian, options=options
            ).x
        coef = coef + unit * found[1:]
        unit = unit * np.exp(found[0])
        if abs(found[0]) < 1e-6:
            break
    return unit, matrix @ coef, weights_of(unit, coef, reward, white)


def _value(variables, reward, features, kl_bound):
    return objective(np.exp(variables[0]), variables[1:], reward, features, kl_bound)


def _gradient(variables, reward, features, kl_bound):
    temperature, coef = np.exp(variables[0]), variables[1:]
    weights = weights_of(temperature, coef, reward, features)
    along_temperature = temperature * (kl_bound - kl_to_uniform(weights))
    return np.concatenate([[along_temperature], features.mean(0) - weights @ features])


def _hessian(variables, reward, features, kl_bound):
    temperature, coef = np.exp(variables[0]), variables[1:]
    weights = weights_of(temperature, coef, reward, features)
    # In (eta, w) the Hessian is the weighted covariance of (advantage, features), over eta.
    rows = np.column_stack([(reward - features @ coef) / temperature, features])
    rows = rows - weights @ rows
    hessian = rows.T @ (weights[:, None] * rows) / temperature
    hessian[0] *= temperature
    hessian[:, 0] *= temperature
    hessian[0, 0] += temperature * (kl_bound - kl_to_uniform(weights))
    return hessian

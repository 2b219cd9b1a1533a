"""Templates of the C code of a policy; `c_header` fills them in."""

from collections.abc import Sequence
from string import Template

from creps_jax.policies.network_mean import Layer

HEADER = Template("""\
/* Parameters for a context, by a policy that was learned with creps_jax $version.
 *
 *     float context[${PREFIX}_NUM_CONTEXTS] = {$example};
 *     float parameters[${PREFIX}_NUM_PARAMETERS];
 *     int is_in_range = ${prefix}_policy(context, parameters);
 *     ... parameters[$first] ...
 *
 * C99 or C++. Needs $functions of <math.h>; allocates nothing. To tell NaN, compile without -ffast-math.
 */
#ifndef ${PREFIX}_POLICY_H
#define ${PREFIX}_POLICY_H

#include <math.h>

#define ${PREFIX}_NUM_CONTEXTS $num_contexts
#define ${PREFIX}_NUM_PARAMETERS $num_params
#define ${PREFIX}_NUM_FEATURES $num_features

$tables
/* Compute the parameters for a context$held.
 *
 * Returns 1 if the context is within the range that was learned, ${prefix}_context_low to
 * ${prefix}_context_high. Returns 0 if a context variable is outside: it is then clamped to the range,
 * NaN to its lower end.
 */
static inline int ${prefix}_policy(
    const float context[${PREFIX}_NUM_CONTEXTS], float parameters[${PREFIX}_NUM_PARAMETERS])
{
    float nearest[${PREFIX}_NUM_CONTEXTS];
    float features[${PREFIX}_NUM_FEATURES];
    int is_in_range = 1;
    int i, j;

    for (i = 0; i < ${PREFIX}_NUM_CONTEXTS; ++i) {
        nearest[i] = context[i];
        if (!(context[i] >= ${prefix}_context_low[i])) { /* less, or NaN */
            nearest[i] = ${prefix}_context_low[i];
            is_in_range = 0;
        } else if (context[i] > ${prefix}_context_high[i]) {
            nearest[i] = ${prefix}_context_high[i];
            is_in_range = 0;
        }
    }

$compute_features
    for (j = 0; j < ${PREFIX}_NUM_PARAMETERS; ++j) {
        float value = 0.0f;
        for (i = 0; i < ${PREFIX}_NUM_FEATURES; ++i) {
            value += features[i] * ${prefix}_coef[i][j];
        }
$hold_bounds        parameters[j] = value;
    }
    return is_in_range;
}

#endif
""")

LINEAR = """\
    features[0] = 1.0f;
    for (i = 0; i < ${PREFIX}_NUM_CONTEXTS; ++i) {
        features[i + 1] = nearest[i];
    }
"""

SCALED = """\
    float scaled[${PREFIX}_NUM_CONTEXTS];
    for (j = 0; j < ${PREFIX}_NUM_CONTEXTS; ++j) {
        scaled[j] = (nearest[j] - ${prefix}_middle[j]) / ${prefix}_half[j];
    }
"""

POLYNOMIAL = (
    SCALED
    + """\
    for (i = 0; i < ${PREFIX}_NUM_FEATURES; ++i) {
        features[i] = 1.0f;
        for (j = 0; j < ${PREFIX}_NUM_CONTEXTS; ++j) {
            int k;
            for (k = 0; k < ${prefix}_exponents[i][j]; ++k) {
                features[i] *= scaled[j];
            }
        }
    }
"""
)

# The largest exponent is subtracted from all, so that the weights cannot all be zero.
RBF = """\
    float largest = 0.0f, sum = 0.0f;
    for (i = 0; i < ${PREFIX}_NUM_FEATURES; ++i) {
        features[i] = 0.0f;
        for (j = 0; j < ${PREFIX}_NUM_CONTEXTS; ++j) {
            const float distance = (nearest[j] - ${prefix}_centers[i][j]) / ${prefix}_widths[j];
            features[i] -= 0.5f * distance * distance;
        }
        if (i == 0 || features[i] > largest) {
            largest = features[i];
        }
    }
    for (i = 0; i < ${PREFIX}_NUM_FEATURES; ++i) {
        features[i] = expf(features[i] - largest);
        sum += features[i];
    }
    for (i = 0; i < ${PREFIX}_NUM_FEATURES; ++i) {
        features[i] /= sum;
    }
"""

KERNEL = (
    SCALED
    + """\
    features[0] = 1.0f;
    for (i = 1; i < ${PREFIX}_NUM_FEATURES; ++i) {
        float square = 0.0f;
        for (j = 0; j < ${PREFIX}_NUM_CONTEXTS; ++j) {
            const float distance = (scaled[j] - ${prefix}_centers[i - 1][j]) / ${prefix}_widths[j];
            square += distance * distance;
        }
        features[i] = expf(-0.5f * square);
    }
"""
)

# Whole layers follow each other; `network` puts in the names and sizes of each.
_LAYER = Template("""\
    float units_$index[$num_units];
    for (i = 0; i < $num_units; ++i) {
        units_$index[i] = ${bias}[i];
        for (j = 0; j < $num_inputs; ++j) {
            units_$index[i] += $inputs[j] * ${weight}[j][i];
        }
        units_$index[i] = tanhf(units_$index[i]);
    }
""")
_LAST_UNITS = Template("""\
    features[0] = 1.0f;
    for (i = 0; i < $num_units; ++i) {
        features[i + 1] = units_$index[i];
    }
""")


def network(layers: Sequence[Layer], prefix: str) -> str:
    """Return the code that computes the features of a network from the array `scaled`.

    Args:
        layers: the layers.
        prefix: what the names of their tables, `weight_0` and so on, begin with.
    """
    code, inputs = "", "scaled"
    for index, layer in enumerate(layers):
        num_inputs, num_units = layer.weight.shape
        code += _LAYER.substitute(
            index=index,
            inputs=inputs,
            num_inputs=num_inputs,
            num_units=num_units,
            weight=f"{prefix}weight_{index}",
            bias=f"{prefix}bias_{index}",
        )
        inputs = f"units_{index}"
    return code + _LAST_UNITS.substitute(index=len(layers) - 1, num_units=layers[-1].weight.shape[1])


_BOUNDS = """\
        const float low = ${prefix}_parameter_low[j], high = ${prefix}_parameter_high[j];
"""
_SQUASH = """\
        value = low + (high - low) / (1.0f + expf(-value));
"""
_CLIP = """\
        value = value < low ? low : value > high ? high : value;
"""
# After a sigmoid, rounding can exceed the bounds by the last bit.
HOLD_BOUNDS = {"none": "", "clip": _BOUNDS + _CLIP, "sigmoid": _BOUNDS + _SQUASH + _CLIP}

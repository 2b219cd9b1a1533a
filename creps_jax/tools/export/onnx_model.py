"""Write a policy as an ONNX model, which many runtimes and languages read."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from creps_jax.files import package_version, write_atomically
from creps_jax.policies.learned import Learned
from creps_jax.tools.export.formula import Formula, formula_of

# The oldest versions with these operators (ReduceSum has its axes as an input since opset 13), so that old
# runtimes can read the model.
OPSET = 13
IR_VERSION = 7


def save(path: Path, policy: Learned) -> None:
    """Write a policy as an ONNX model, atomically."""
    model = make_model(policy)
    write_atomically(path, lambda file: file.write(model.SerializeToString()))


def make_model(policy: Learned) -> onnx.ModelProto:
    """Build the model: `context` (batch, s) to `parameters` (batch, d) and `in_range` (batch,).

    Context variables outside the learned range are clamped to it, NaN to the lower end; `in_range` is true if
    all are inside. The metadata has names, units, bounds and range as JSON.

    Raises:
        UserError: if a number of the policy is too large for single precision.
    """
    formula = formula_of(policy)
    nodes = [
        *_clamp(),
        *_mean(formula.kind, len(formula.layers)),
        *_hold_bounds(policy.parameters.constraint),
    ]
    used = {name for node in nodes for name in node.input}
    constants = _constants(formula)
    tensors = [numpy_helper.from_array(values, name) for name, values in constants.items() if name in used]
    contexts, params = ", ".join(policy.contexts.names), ", ".join(policy.parameters.names)
    value = helper.make_tensor_value_info
    context = value("context", TensorProto.FLOAT, ["batch", len(policy.contexts.names)], contexts)
    parameters = value("parameters", TensorProto.FLOAT, ["batch", len(policy.parameters.names)], params)
    in_range = value(
        "in_range", TensorProto.BOOL, ["batch"], "whether the context is within the learned range"
    )
    graph = helper.make_graph(nodes, "policy", [context], [parameters, in_range], tensors)
    model = helper.make_model(
        graph,
        producer_name="creps_jax",
        producer_version=package_version(),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        doc_string=_description(policy),
    )
    helper.set_model_props(model, {name: json.dumps(value) for name, value in _metadata(policy).items()})
    return model


def _clamp() -> list[onnx.NodeProto]:
    """Compute `nearest` and `in_range` from `context`; comparisons with NaN are false."""
    return [
        _node("not_below", "GreaterOrEqual", "context", "context_low"),
        _node("raised", "Where", "not_below", "context", "context_low"),
        _node("not_above", "LessOrEqual", "raised", "context_high"),
        _node("nearest", "Where", "not_above", "raised", "context_high"),
        _node("is_inside", "And", "not_below", "not_above"),
        # ONNX has no "all" of booleans.
        _node("inside", "Cast", "is_inside", to=TensorProto.FLOAT),
        _node("all_inside", "ReduceMin", "inside", axes=[1], keepdims=0),
        _node("in_range", "Cast", "all_inside", to=TensorProto.BOOL),
    ]


def _mean(kind: str, num_layers: int) -> list[onnx.NodeProto]:
    """Compute `mean`, the parameters before any bounds are applied, from `nearest`."""
    scaled = [_node("from_middle", "Sub", "nearest", "middle"), _node("scaled", "Div", "from_middle", "half")]
    if kind == "network":
        for index in range(num_layers):
            scaled += [
                _node(
                    f"sum_{index}", "MatMul", f"units_{index - 1}" if index else "scaled", f"weight_{index}"
                ),
                _node(f"input_{index}", "Add", f"sum_{index}", f"bias_{index}"),
                _node(f"units_{index}", "Tanh", f"input_{index}"),
            ]
        return [*scaled, *_affine(f"units_{num_layers - 1}")]
    if kind == "linear":
        return _affine("nearest")
    if kind == "polynomial":
        return [
            *scaled,
            _node("row", "Unsqueeze", "scaled", "middle_axis"),
            _node("powers", "Pow", "row", "exponents"),
            _node("features", "ReduceProd", "powers", axes=[2], keepdims=0),
            _node("mean", "MatMul", "features", "coef"),
        ]
    log_weights = [
        _node("row", "Unsqueeze", "scaled" if kind == "kernel" else "nearest", "middle_axis"),
        _node("offset", "Sub", "row", "centers"),
        _node("distance", "Div", "offset", "widths"),
        _node("squares", "Mul", "distance", "distance"),
        _node("square", "ReduceSum", "squares", "last_axis", keepdims=0),
        _node("log_weights", "Mul", "square", "minus_half"),
    ]
    if kind == "kernel":
        return [*scaled, *log_weights, _node("features", "Exp", "log_weights"), *_affine("features")]
    return [
        *log_weights,
        _node("features", "Softmax", "log_weights", axis=1),
        _node("mean", "MatMul", "features", "coef"),
    ]


def _affine(features: str) -> list[onnx.NodeProto]:
    """Compute `mean` from features without their constant."""
    return [_node("rise", "MatMul", features, "slope"), _node("mean", "Add", "rise", "intercept")]


def _hold_bounds(constraint: str) -> list[onnx.NodeProto]:
    """Compute `parameters` from `mean`."""
    if constraint == "none":
        return [_node("parameters", "Identity", "mean")]
    squash = [
        _node("share", "Sigmoid", "mean"),
        _node("above_low", "Mul", "share", "param_range"),
        _node("squashed", "Add", "above_low", "param_low"),
    ]
    is_squashed = constraint == "sigmoid"
    return [
        *(squash if is_squashed else []),
        # After a sigmoid, rounding can exceed the bounds by the last bit.
        _node("not_too_low", "Max", "squashed" if is_squashed else "mean", "param_low"),
        _node("parameters", "Min", "not_too_low", "param_high"),
    ]


def _constants(formula: Formula) -> dict[str, np.ndarray]:
    """Return all constants that a node may use, by name."""
    numbers = {name: values for name, values in formula._asdict().items() if name not in ("kind", "layers")}
    for index, layer in enumerate(formula.layers):
        numbers |= {f"{name}_{index}": values for name, values in layer._asdict().items()}
    return numbers | {
        "intercept": formula.coef[0],
        "slope": formula.coef[1:],
        "minus_half": np.array(-0.5, np.float32),
        "middle_axis": np.array([1]),
        "last_axis": np.array([2]),
        "param_range": formula.param_high - formula.param_low,
    }


def _node(output: str, operator: str, *inputs: str, **attributes: Any) -> onnx.NodeProto:
    return helper.make_node(operator, inputs, [output], **attributes)


def _metadata(policy: Learned) -> dict[str, Any]:
    """Return the metadata of the model."""
    return {
        "task": dict(policy.task),
        "context_names": policy.contexts.names,
        "context_units": policy.contexts.units,
        "context_low": policy.contexts.low,
        "context_high": policy.contexts.high,
        "parameter_names": policy.parameters.names,
        "parameter_units": policy.parameters.units,
        "parameter_low": policy.parameters.low,
        "parameter_high": policy.parameters.high,
        "constraint": policy.parameters.constraint,
    }


def _description(policy: Learned) -> str:
    """Return a description of the model."""
    ranges = zip(
        policy.contexts.names, policy.contexts.low, policy.contexts.high, policy.contexts.units, strict=True
    )
    learned = ", ".join(f"{name} {low:g} to {high:g} {unit}".rstrip() for name, low, high, unit in ranges)
    return (
        f"Parameters of the task {policy.task.get('name', 'unknown')} for a context, by a policy that was "
        f"learned with creps_jax. Learned range: {learned}. A context outside is clamped to the range, "
        "and in_range is false."
    )

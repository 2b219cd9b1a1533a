"""Write a policy as a C header that needs only expf, for microcontrollers and robots."""

import re
import string
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from creps_jax.files import package_version, save_text
from creps_jax.policies.learned import Learned
from creps_jax.tools.export.c_code import (
    HEADER,
    HOLD_BOUNDS,
    KERNEL,
    LINEAR,
    POLYNOMIAL,
    RBF,
    SCALED,
    network,
)
from creps_jax.tools.export.formula import Formula, formula_of

# Characters that need no escape in a C string: not quotes, backslashes, nor "?", as "??" starts a trigraph.
_PLAIN = string.ascii_letters + string.digits + " _.,:;/^*+-=%()[]"


def save(path: Path, policy: Learned) -> None:
    """Write a policy as a C header, atomically; the name of the file is the prefix of its identifiers."""
    save_text(path, make_header(policy, path.stem))


def make_header(policy: Learned, name: str | None = None) -> str:
    """Return a header of C99 and C++ with names, units, bounds, range and function of a policy.

    The name, by default the name of the task, is the prefix of all identifiers; characters that are not
    allowed in C become underscores.

    Raises:
        UserError: if a number of the policy is too large for single precision.
    """
    formula = formula_of(policy)
    prefix = _prefix(str(policy.task.get("name", "")) if name is None else name)
    names = {"prefix": prefix, "PREFIX": prefix.upper()}
    features = {"linear": LINEAR, "polynomial": POLYNOMIAL, "rbf": RBF, "kernel": KERNEL, "network": SCALED}
    layers = network(formula.layers, f"{prefix}_") if formula.layers else ""
    is_bounded = policy.parameters.constraint != "none"
    held = f", within {prefix}_parameter_low to {prefix}_parameter_high" if is_bounded else ""
    middle = 0.5 * (formula.context_low + formula.context_high)
    return HEADER.substitute(
        names,
        version=package_version(),
        functions="expf and tanhf" if formula.layers else "expf",
        example=", ".join(f"{value:g}" for value in middle),
        first=_enumerators(f"{prefix}_PARAMETER", policy.parameters.names)[0],
        num_contexts=len(policy.contexts.names),
        num_params=len(policy.parameters.names),
        num_features=len(formula.coef),
        tables=_tables(policy, formula, prefix),
        held=held,
        compute_features=string.Template(features[formula.kind]).substitute(names) + layers,
        hold_bounds=string.Template(HOLD_BOUNDS[policy.parameters.constraint]).substitute(names),
    )


def _tables(policy: Learned, formula: Formula, prefix: str) -> str:
    """Declare the indices, names, units and numbers of a policy."""
    contexts, params, features = (
        f"{prefix.upper()}_NUM_{what}" for what in ("CONTEXTS", "PARAMETERS", "FEATURES")
    )
    tables = [
        _enum(f"{prefix}_context", policy.contexts.names),
        _enum(f"{prefix}_parameter", policy.parameters.names),
        _strings(f"{prefix}_context_names[{contexts}]", policy.contexts.names),
        _strings(f"{prefix}_context_units[{contexts}]", policy.contexts.units),
        floats(f"{prefix}_context_low[{contexts}]", formula.context_low),
        floats(f"{prefix}_context_high[{contexts}]", formula.context_high),
        _strings(f"{prefix}_parameter_names[{params}]", policy.parameters.names),
        _strings(f"{prefix}_parameter_units[{params}]", policy.parameters.units),
        floats(f"{prefix}_parameter_low[{params}]", formula.param_low),
        floats(f"{prefix}_parameter_high[{params}]", formula.param_high),
        floats(f"{prefix}_coef[{features}][{params}]", formula.coef),
    ]
    if len(formula.centers):
        num = features if formula.kind == "rbf" else f"{features} - 1"
        tables.append(floats(f"{prefix}_centers[{num}][{contexts}]", formula.centers))
        tables.append(floats(f"{prefix}_widths[{contexts}]", formula.widths))
    if formula.kind in ("polynomial", "kernel", "network"):
        tables.append(floats(f"{prefix}_middle[{contexts}]", formula.middle))
        tables.append(floats(f"{prefix}_half[{contexts}]", formula.half))
    if formula.kind == "polynomial":
        rows = [f"{{{', '.join(map(str, row))}}}" for row in formula.exponents.tolist()]
        tables.append(f"static const int {prefix}_exponents[{features}][{contexts}] = {{{_lines(rows)}}};\n")
    return "\n".join([*tables, *layer_tables(formula, f"{prefix}_")])


def layer_tables(formula: Formula, prefix: str) -> list[str]:
    """Declare the weights and biases of the layers of a network."""
    return [
        floats(f"{prefix}{name}_{index}{''.join(f'[{size}]' for size in values.shape)}", values)
        for index, layer in enumerate(formula.layers)
        for name, values in layer._asdict().items()
    ]


def _prefix(name: str) -> str:
    """Return a name as the prefix of C identifiers."""
    name = identifier(name).lower()
    return f"task_{name}" if name[:1].isdigit() else name or "learned"


def identifier(name: str) -> str:
    """Return a name with underscores in place of what C does not allow in one."""
    return re.sub("[^0-9A-Za-z]+", "_", name).strip("_")


def _enumerators(tag: str, names: Sequence[str]) -> list[str]:
    """Make C identifiers of names; if two are equal, all get their index."""
    stems = [f"{tag}_{identifier(name)}".upper() for name in names]
    return stems if len(set(stems)) == len(stems) else [f"{stem}_{i}" for i, stem in enumerate(stems)]


def _enum(tag: str, names: Sequence[str]) -> str:
    return f"enum {tag} {{{_lines(_enumerators(tag, names))}}};\n"


def _strings(declarator: str, values: Iterable[str]) -> str:
    return f"static const char *const {declarator} = {{{_lines(map(string_literal, values))}}};\n"


def floats(declarator: str, values: np.ndarray) -> str:
    """Declare a vector, or a matrix with a brace for each row."""
    rows = [", ".join(map(number, row)) for row in np.atleast_2d(values)]
    rows = [f"{{{row}}}" for row in rows] if values.ndim == 2 else rows
    indent = " " * (values.ndim - 1)
    wrapped = [textwrap.fill(row, 96, subsequent_indent=indent, break_on_hyphens=False) for row in rows]
    return f"static const float {declarator} = {{{_lines(wrapped)}}};\n"


def _lines(items: Iterable[str]) -> str:
    """Return items, each in a line."""
    return "\n" + textwrap.indent(",\n".join(items), "    ") + "\n"


def string_literal(text: str) -> str:
    """Return a C string literal: other than plain characters as octal numbers of their UTF-8 bytes."""
    return '"' + "".join(chr(b) if chr(b) in _PLAIN else f"\\{b:03o}" for b in text.encode()) + '"'


def number(value: np.floating) -> str:
    """Return a float literal that reads back as the same number."""
    if np.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    digits = f"{value:.9g}"
    return f"{digits}f" if set(digits) & set(".e") else f"{digits}.0f"

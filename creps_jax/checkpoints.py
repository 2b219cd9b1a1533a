"""Save and load the state and the log of a run, so that it can be resumed."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from creps_jax.errors import UserError
from creps_jax.files import load_arrays, save_arrays

_FORMAT = "creps_jax checkpoint 1"
_STATE, _LOG = "state.", "log."


class Checkpoint(NamedTuple):
    """The state of a search, and its log.

    Attributes:
        state: a pytree of arrays.
        log: arrays by name, with a leading axis of iterations.
    """

    state: Any
    log: dict[str, np.ndarray]


def named_leaves(tree: Any, prefix: str = "") -> dict[str, np.ndarray]:
    """Flatten a pytree to arrays by name: `info.kl` is the field kl of the field info."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {
        prefix + jax.tree_util.keystr(path, simple=True, separator="."): np.asarray(leaf)
        for path, leaf in leaves
    }


def append_log(log: Mapping[str, np.ndarray], row: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Append the arrays of one iteration to the log, whose arrays have a leading axis of iterations."""
    new = {name: values[None] for name, values in row.items()}
    return {name: np.concatenate([log[name], new[name]]) for name in new} if log else new


def save_checkpoint(path: Path, checkpoint: Checkpoint, *, run: Mapping[str, Any]) -> None:
    """Write a checkpoint atomically.

    Args:
        path: an .npz file.
        checkpoint: state and log.
        run: identity of the run, as plain values: experiment, settings, seed, trial.

    Raises:
        UserError: if the file cannot be written; an earlier checkpoint is kept.
    """
    arrays = {"format": np.array(_FORMAT), "run": np.array(_canonical(run))}
    arrays |= named_leaves(checkpoint.state, _STATE)
    arrays |= {_LOG + name: values for name, values in checkpoint.log.items()}
    save_arrays(path, arrays)


def load_checkpoint(path: Path, template: Any, *, run: Mapping[str, Any]) -> Checkpoint:
    """Read a checkpoint; the file is not changed.

    Args:
        path: the .npz file.
        template: a state of the expected structure, shapes and types.
        run: as for `save_checkpoint`; a checkpoint of another run is refused.

    Raises:
        UserError: if the file is missing, is cut short, is not a checkpoint, or belongs to another run.
    """
    arrays = load_arrays(path)
    if str(arrays.get("format")) != _FORMAT:
        raise UserError(f"{path} is no checkpoint of this program ({_FORMAT})")
    _check_same_run(path, json.loads(str(arrays["run"])), json.loads(_canonical(run)))
    leaves = []
    for name, wanted in named_leaves(template, _STATE).items():
        saved = arrays.get(name)
        if saved is None or saved.shape != wanted.shape or saved.dtype != wanted.dtype:
            found = "nothing" if saved is None else f"{saved.dtype}{saved.shape}"
            raise UserError(f"{path}: expected {wanted.dtype}{wanted.shape} for {name}, found {found}")
        leaves.append(saved)
    state = jax.tree.unflatten(jax.tree.structure(template), [jax.numpy.asarray(leaf) for leaf in leaves])
    log = {name.removeprefix(_LOG): values for name, values in arrays.items() if name.startswith(_LOG)}
    return Checkpoint(state, log)


def _check_same_run(path: Path, saved: dict[str, Any], wanted: dict[str, Any]) -> None:
    for name in sorted(saved.keys() | wanted.keys()):
        if saved.get(name) != wanted.get(name):
            raise UserError(
                f"{path} belongs to another run: its {name} is {saved.get(name)}, expected {wanted.get(name)}"
            )


def _canonical(values: Mapping[str, Any]) -> str:
    return json.dumps(values, sort_keys=True, default=str)

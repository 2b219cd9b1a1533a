"""Measure plan and motion of a walk that stays up and of one that falls."""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from creps_jax.errors import UserError
from creps_jax.numerics.rotations import quat_to_rpy
from creps_jax.robots.nao_geometry import JOINT_NAMES
from creps_jax.tasks.closed_loop import WalkNoise
from creps_jax.tasks.walking import record_walk
from creps_jax.tools import plots
from creps_jax.tools.play import balance_of, load_walking_policy, shipped_policy
from creps_jax.typing import Scalar
from creps_jax.walking.controller import WalkerState
from creps_jax.walking.gaits import AHEAD, straight_walker
from creps_jax.walking.open_loop import open_loop_walk
from creps_jax.walking.posture import Balance
from creps_jax.walking.zmp import zmp_reference
from experiments.learning import Session
from experiments.probe import Measured, Probe
from experiments.records import Arrays, Part, named
from experiments.registry import Claim

GAITS = {"good": "with foot placement", "bad": "without foot placement"}
KNEE = JOINT_NAMES.index("left_knee")
WINDOW = 1.2


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of the experiment.

    Attributes:
        speed: asked speed, m/s.
        noise: factor of the usual noise.
        duration: length of an episode, s.
        candidates: number of seeds to try until the bad gait falls and the good one does not.
    """

    speed: float = 0.6
    noise: float = 1.6
    duration: float = 8.0
    candidates: int = 64


SETTINGS = {"quick": Settings()}


def run(settings: Settings, key: jax.Array, session: Session = Session()) -> dict[str, np.ndarray]:
    """Walk with the shipped policy, with its foot placement and without, in the same noise.

    Returns:
        A part for each of `GAITS`: the fields of `Measured` until the robot falls, and `zmp_plan` and
        `com_plan`: the lateral plan at the same times, from the middle of the feet, m.

    Raises:
        UserError: if no seed among the candidates makes the bad gait fall and the good one not.
    """
    del session
    saved = load_walking_policy(shipped_policy())
    theta = jnp.asarray(saved.theta(settings.speed))
    balances = {"good": balance_of(saved), "bad": balance_of(saved)._replace(placement_gain=0.0)}
    walkers = {name: _Walker(settings, balance) for name, balance in balances.items()}
    for candidate in jax.random.split(key, settings.candidates):
        bad = walkers["bad"](candidate, theta)
        if bad.fell and not (good := walkers["good"](candidate, theta)).fell:
            break
    else:
        raise UserError(
            f"no seed of {settings.candidates} tells the gaits apart; take more candidates, or more noise"
        )
    arrays = {}
    for name, walk in {"good": good, "bad": bad}.items():
        arrays |= named(name, walk.upright._asdict() | _plan(theta, walk.upright.time))
    return arrays


class _Walked(NamedTuple):
    """A walk until the robot falls."""

    upright: Measured
    fell: bool


class _Walker:
    """Walk many times with the same compiled program, and measure."""

    def __init__(self, settings: Settings, balance: Balance):
        self._probe = Probe()
        noise = WalkNoise().times(settings.noise)
        physics = self._probe.make_control_step
        self._record = jax.jit(
            partial(record_walk, duration=settings.duration, noise=noise, balance=balance, physics=physics)
        )

    def __call__(self, key: jax.Array, theta: jax.Array) -> _Walked:
        has_fallen = np.asarray(self._record(key, theta).has_fallen)
        measured = self._probe.take()
        ticks = int(np.sum(~has_fallen)) * (len(measured.time) // len(has_fallen))
        return _Walked(Measured(*(field[:ticks] for field in measured)), bool(has_fallen[-1]))


def _plan(theta: jax.Array, times: np.ndarray) -> dict[str, np.ndarray]:
    """Return the lateral plan of the walk without feedback, at times with equal distances from 0 on."""
    walker = straight_walker(theta, period=float(times[1]))

    def lateral(state: WalkerState) -> tuple[Scalar, Scalar]:
        params, com, step = state.gait.params, state.plan.com, state.plan.footstep
        phase = state.time / params.step_duration
        start, end = (0.5 * (step.support + swing)[:2] for swing in (step.swing_start, step.swing_end))
        share = params.double_support / params.step_duration
        zmp = zmp_reference(phase[None], start, step.support[:2], end, share)[0, 1]
        middle = jnp.where(phase < 0.5, start[1], end[1])
        return zmp - middle, jnp.interp(phase, jnp.linspace(0.0, 1.0, len(com)), com[:, 1]) - middle

    commands = jnp.tile(jnp.array(AHEAD), (len(times) - 1, 1))
    zmp, com = jax.jit(lambda given: jax.vmap(lateral)(open_loop_walk(walker, given)))(commands)
    return {"zmp_plan": np.asarray(zmp), "com_plan": np.asarray(com)}


def inside(arrays: Arrays, name: str) -> dict[str, np.ndarray]:
    """Return the arrays of a gait that the figure and the table show."""
    part = Part(arrays, name)
    heading = np.asarray(jax.vmap(quat_to_rpy)(jnp.float32(part["quat"])))
    middle = part["soles"][:, :, 1].mean(axis=1)
    loaded_speed = np.linalg.norm(part["sole_velocity"][..., :2], axis=2) * part["is_loaded"]
    same = ("time", "zmp_plan", "com_plan", "joint_pos", "set_point", "torque_share", "is_loaded")
    return {field: part[field] for field in same} | {
        "forward": part["com"][:, 0],
        "zmp": part["zmp"][:, 1] - middle,
        "com": part["com"][:, 1] - middle,
        "heights": part["soles"][..., 2],
        "slip": loaded_speed.min(axis=1, where=part["is_loaded"], initial=np.inf),
        "rpy": np.unwrap(heading, axis=0),
    }


def table(arrays: Arrays) -> dict[str, list[object]]:
    """Return what limits each gait, in numbers, while the robot is upright."""
    gaits = {label: _numbers(inside(arrays, name)) for name, label in GAITS.items()}
    columns: dict[str, list[object]] = {"measured": list(gaits[GAITS["good"]])}
    for label, numbers in gaits.items():
        columns[label] = list(numbers.values())
    return columns


def _numbers(seen: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return the rows of the table for a gait."""
    rms = lambda x: np.sqrt(np.nanmean(np.square(x)))  # noqa: E731
    time, distance = seen["time"], seen["forward"][-1] - seen["forward"][0]
    slid = np.sum(np.where(np.isfinite(seen["slip"]), seen["slip"], 0.0)) * (time[1] - time[0])
    rows = {
        "upright, s": time[-1],
        "forward, m/s": distance / time[-1],
        "ZMP from its reference, lateral, rms mm": 1e3 * rms(seen["zmp"] - seen["zmp_plan"]),
        "CoM from its plan, lateral, rms mm": 1e3 * rms(seen["com"] - seen["com_plan"]),
        "leg joints from their set-points, rms deg": np.degrees(
            rms((seen["joint_pos"] - seen["set_point"])[:, -12:])
        ),
        "time with a torque at its limit, %": 100.0 * np.mean(seen["torque_share"] > 0.999),
        "loaded sole slides, mm for each m walked": 1e3 * slid / distance,
        "swing sole's height, median of its maxima, mm": 1e3 * np.median(_peaks(seen["heights"])),
        "both soles off the floor, % of the time": 100.0 * np.mean(~seen["is_loaded"].any(axis=1)),
        "largest roll, deg": np.degrees(np.abs(seen["rpy"][:, 0]).max()),
        "heading at the end, deg": np.degrees(seen["rpy"][-1, 2]),
    }
    return {name: float(value) for name, value in rows.items()}


def _peaks(heights: np.ndarray) -> np.ndarray:
    """Return the local maxima above 5 mm of the heights (n, 2) of both soles."""
    inner = heights[1:-1]
    return inner[(inner > heights[:-2]) & (inner >= heights[2:]) & (inner > 0.005)]


def plot(arrays: Arrays) -> dict[str, Figure]:
    """Draw both gaits side by side: a second before the bad one falls, and the tilt all the way."""
    figure, axes = plots.new_figure(5, 2, width=11.0, height=12.0, sharey="row")
    gaits = {name: inside(arrays, name) for name in GAITS}
    end = float(gaits["bad"]["time"][-1])
    for column, (name, seen) in zip(axes.T, gaits.items(), strict=True):
        near = (seen["time"] > end - WINDOW) & (seen["time"] <= end)
        _draw(column, {field: values[near] for field, values in seen.items()})
        column[0].set_title(GAITS[name])
        roll, _, yaw = np.degrees(seen["rpy"]).T
        column[4].plot(seen["time"], roll, label="roll")
        column[4].plot(seen["time"], yaw, label="heading")
        column[4].axvspan(end - WINDOW, end, color=plots.PAPER_COLOUR, alpha=0.2, lw=0)
        # One scale for both, although one of the walks ends early.
        column[4].set_xlim(0.0, max(each["time"][-1] for each in gaits.values()))
        column[4].set_xlabel("time (s); the grey part is shown above")
    for row, label in zip(
        axes[:, 0],
        (
            "sideways (mm)",
            "left knee (deg)",
            "largest leg torque\n(share of limit)",
            "sole's height (mm)",
            "angle (deg)",
        ),
        strict=True,
    ):
        row.set_ylabel(label)
    for row in axes[[0, 1, 3, 4], 0]:
        row.legend(ncols=4, fontsize=8, loc="upper left")
    axes[0, 0].set_ylim(-160, 160)
    return {"inside": figure}


def _draw(axes: np.ndarray, seen: Mapping[str, np.ndarray]) -> None:
    time = seen["time"]
    lines: list[tuple[Axes, np.ndarray, str, str, str]] = [
        (axes[0], 1e3 * seen["zmp_plan"], "ZMP, reference", "--", plots.COLOURS[0]),
        (axes[0], 1e3 * seen["zmp"], "ZMP", "-", plots.COLOURS[0]),
        (axes[0], 1e3 * seen["com_plan"], "CoM, plan", "--", plots.COLOURS[1]),
        (axes[0], 1e3 * seen["com"], "CoM", "-", plots.COLOURS[1]),
        (axes[1], np.degrees(seen["set_point"][:, KNEE]), "set-point", "--", plots.COLOURS[0]),
        (axes[1], np.degrees(seen["joint_pos"][:, KNEE]), "measured", "-", plots.COLOURS[1]),
        (axes[2], seen["torque_share"], "", "-", plots.COLOURS[0]),
        (axes[3], 1e3 * seen["heights"][:, 0], "left", "-", plots.COLOURS[0]),
        (axes[3], 1e3 * seen["heights"][:, 1], "right", "-", plots.COLOURS[1]),
    ]
    for place, values, label, style, colour in lines:
        place.plot(time, values, style, color=colour, label=label, lw=1.4)
    axes[2].axhline(1.0, color=plots.FALL_COLOUR, lw=1.0)


CLAIMS: tuple[Claim, ...] = ()

"""Measure speed and memory of walking rollouts by batch size, physics and number of devices.

    python -m experiments.benchmarks.scaling [--sizes 32 128] [--physics mjx c] [--devices 1 2]

Each row is measured in a new process, without the cache of compiled programs, so that its peak of memory
belongs to this row. With C MuJoCo, too, one of several devices has its share of the cores. "without physics"
is the time of the same rollouts without simulation steps: planning, controller and noise.
"""

import itertools
import multiprocessing
import re
import resource
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
import tyro

from creps_jax.errors import UserError
from creps_jax.rollouts import compiled_roll_out
from creps_jax.simulation.state import ControlStep, Physics, RobotState
from creps_jax.tasks.closed_loop import CONTROL_PERIOD
from creps_jax.tools import tables
from creps_jax.tools.command_line import answer
from creps_jax.tools.process import usable_cores
from experiments.benchmarks.rollouts import walking_batch
from experiments.walking.settings import PHYSICS, TIMESTEP

SIZES = (32, 128, 512, 2048, 4096)
ROUNDS = 5
LONGEST = 10.0
"""Seconds after which no more rounds start."""

T = TypeVar("T")


class Case(NamedTuple):
    """A row of the table: physics, number of devices, batch size, and duration of an episode in s."""

    physics: str
    devices: int
    size: int
    duration: float


class Measured(NamedTuple):
    """The measurements of a case: seconds, and MiB.

    Attributes:
        compiling: time to compile.
        running: time of all episodes, the median of the rounds.
        without_physics: the same without simulation steps.
        compiled_memory: peak memory of the process before its first rollout.
        peak_memory: peak memory of the process.
        buffers: memory of the compiled program on all its devices.
        device_memory: peak memory of a device; None if it does not report it, such as a CPU.
    """

    compiling: float
    running: float
    without_physics: float
    compiled_memory: float
    peak_memory: float
    buffers: float
    device_memory: float | None


def main(
    sizes: tuple[int, ...] = SIZES,
    physics: tuple[str, ...] = ("mjx", "c"),
    devices: tuple[int, ...] = (),
    duration: float = 1.0,
) -> None:
    """Measure every combination, and print a Markdown table.

    Args:
        sizes: Episodes in a batch.
        physics: Simulation of the robot, mjx or c.
        devices: Numbers of devices that share a batch; one and all by default.
        duration: Length of an episode, s.
    """
    platform, num_devices = in_new_process(describe_devices)
    devices = devices or tuple(sorted({1, num_devices}))
    check(sizes, physics, devices, duration, num_devices)
    print(
        f"{usable_cores()} cores, {num_devices} devices ({platform}), episodes of {duration:g} s", flush=True
    )
    rows: dict[Case, Measured | str] = {}
    try:
        for name, num in itertools.product(physics, devices):
            measure_sizes(rows, [Case(name, num, size, duration) for size in sorted(sizes)])
    finally:  # an interrupt prints the rows that are measured
        print(f"\n{tables.to_markdown(columns(rows))}")


def measure_sizes(rows: dict[Case, Measured | str], cases: Sequence[Case]) -> None:
    """Measure cases of growing size, each in a new process, until the memory is too small."""
    for case in cases:
        print(f"{case.physics}, devices {case.devices}, batch {case.size} ...", file=sys.stderr, flush=True)
        try:
            rows[case] = in_new_process(measure, case)
        except BrokenProcessPool:
            rows[case] = "killed"
        if isinstance(rows[case], str):
            return


def check(
    sizes: Sequence[int], physics: Sequence[str], devices: Sequence[int], duration: float, num_devices: int
) -> None:
    """Check the cases.

    Raises:
        UserError: for a case that cannot be measured.
    """
    for name in physics:
        if name not in PHYSICS:
            raise UserError(f"physics must be among {', '.join(PHYSICS)}, got {name!r}")
    if not sizes or min(sizes) < 1:
        raise UserError(f"sizes must be at least 1, got {sizes}")
    if not all(1 <= num <= num_devices for num in devices):
        raise UserError(f"devices must be from 1 to {num_devices}, got {devices}")
    if not duration >= 2 * CONTROL_PERIOD:
        raise UserError(f"an episode must last at least {2 * CONTROL_PERIOD} s, got {duration}")


def in_new_process(function: Callable[..., T], *arguments: Any) -> T:
    """Call a function in a new process.

    Raises:
        BrokenProcessPool: if the process is killed.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(function, *arguments).result()


def describe_devices() -> tuple[str, int]:
    """Return the kind and the number of the devices."""
    return jax.devices()[0].device_kind, jax.device_count()


def measure(case: Case) -> Measured | str:
    """Compile and run a case; return "out of memory" if the memory of a device is too small."""
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        return _measure(case)
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        return "out of memory"


def _measure(case: Case) -> Measured:
    begin = time.perf_counter()
    compiled, run = _compile(case, PHYSICS[case.physics])
    compiling, compiled_memory = time.perf_counter() - begin, peak_memory()
    running, largest = _median_seconds(run), peak_memory()
    sizes = compiled.memory_analysis()
    buffers = sizes.temp_size_in_bytes + sizes.argument_size_in_bytes + sizes.output_size_in_bytes
    stats = jax.devices()[0].memory_stats() or {}
    device_memory = stats.get("peak_bytes_in_use")
    _, run_without = _compile(case, _no_physics)
    return Measured(
        compiling=compiling,
        running=running,
        without_physics=_median_seconds(run_without),
        compiled_memory=compiled_memory,
        peak_memory=largest,
        buffers=case.devices * buffers / 2**20,
        device_memory=None if device_memory is None else device_memory / 2**20,
    )


def _compile(case: Case, physics: Physics) -> tuple[Any, Callable[[], Any]]:
    """Compile the rollouts of a case; return the program, and a function that runs it."""
    task, contexts, thetas = walking_batch(case.size, case.duration, physics)
    devices = tuple(jax.devices()[: case.devices])
    batch = (jax.random.key(0), contexts, thetas)
    compiled = compiled_roll_out(task, devices).lower(*batch).compile()
    batch = jax.device_put(batch, compiled.input_shardings[0])
    return compiled, lambda: jax.block_until_ready(compiled(*batch))


def _no_physics(*_: Any) -> ControlStep:
    """Return a control step that hardly moves the robot; it uses all inputs, so that XLA computes them."""

    def control_step(state: RobotState, before: jax.Array, after: jax.Array, speed: jax.Array) -> RobotState:
        change = 1e-9 * (before + after + speed).sum()
        return state._replace(qpos=state.qpos.at[0].add(change))

    return control_step


def _median_seconds(run: Callable[[], Any]) -> float:
    seconds: list[float] = []
    while len(seconds) < ROUNDS and sum(seconds) < LONGEST:
        begin = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - begin)
    return float(np.median(seconds))


def peak_memory() -> float:
    """Return the peak memory of this process so far, MiB."""
    status = Path("/proc/self/status")
    # On Linux, getrusage may report the memory of the parent process.
    if status.exists() and (found := re.search(r"VmHWM:\s*(\d+) kB", status.read_text())):
        return int(found[1]) / 2**10
    unit = 1 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


def columns(rows: Mapping[Case, Measured | str]) -> dict[str, list[str]]:
    """Return the columns of the table; the speed of a case that was not measured is the reason."""
    done = {case: measured for case, measured in rows.items() if not isinstance(measured, str)}
    table: dict[str, list[str]] = {}

    def add(name: str, text: Callable[[Case, Measured], str], otherwise: Callable[[Case], str]) -> None:
        table[name] = [text(case, done[case]) if case in done else otherwise(case) for case in rows]

    def speed(case: Case) -> float:
        return case.size * case.duration / done[case].running

    def times_one_device(case: Case, _: Measured) -> str:
        one = case._replace(devices=1)
        return f"{speed(case) / speed(one):.2f}" if one in done else "-"

    for name in ("physics", "devices", "size"):
        table["batch" if name == "size" else name] = [str(getattr(case, name)) for case in rows]
    add("x real time", lambda case, _: f"{speed(case):,.0f}", lambda case: str(rows[case]))
    add("steps/s", lambda case, _: f"{speed(case) / TIMESTEP:,.0f}", lambda _: "-")
    add("x one device", times_one_device, lambda _: "-")
    add("run s", lambda _, it: f"{it.running:.2f}", lambda _: "-")
    add("without physics", lambda _, it: f"{it.without_physics / it.running:.0%}", lambda _: "-")
    add("compile s", lambda _, it: f"{it.compiling:.0f}", lambda _: "-")
    add("peak MiB", lambda _, it: f"{it.peak_memory:,.0f}", lambda _: "-")
    add("compiled MiB", lambda _, it: f"{it.compiled_memory:,.0f}", lambda _: "-")
    add("buffers MiB", lambda _, it: f"{it.buffers:,.1f}", lambda _: "-")
    if any(measured.device_memory is not None for measured in done.values()):
        add("device MiB", lambda _, it: f"{it.device_memory or 0:,.0f}", lambda _: "-")
    return table


if __name__ == "__main__":
    sys.exit(answer(lambda: tyro.cli(main)))

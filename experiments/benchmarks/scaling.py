"""Measure how walking rollouts scale: their speed and memory by batch size, physics and number of devices.

    python -m experiments.benchmarks.scaling [--sizes 32 128] [--physics mjx c] [--devices 1 2]

Each row is measured in a process of its own, which compiles anew, so that its peak of memory is its own. One
device of several has its share of the cores for C MuJoCo, too. The time without physics is that of the same
rollouts where the robot is not stepped: planning, controller and noise.
"""

from creps_jax.tools.process import import_mjx_quietly, prepare, usable_cores

prepare()
import_mjx_quietly()

import itertools  # noqa: E402
import multiprocessing  # noqa: E402
import re  # noqa: E402
import resource  # noqa: E402
import sys  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable, Mapping, Sequence  # noqa: E402
from concurrent.futures import ProcessPoolExecutor  # noqa: E402
from concurrent.futures.process import BrokenProcessPool  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any, NamedTuple, TypeVar  # noqa: E402

import jax  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402

from creps_jax.errors import UserError  # noqa: E402
from creps_jax.rollouts import roll_out  # noqa: E402
from creps_jax.simulation.state import ControlStep, RobotState  # noqa: E402
from creps_jax.tasks.walking import CONTROL_PERIOD, Physics  # noqa: E402
from creps_jax.tools import tables  # noqa: E402
from experiments.benchmarks.rollouts import walking_batch  # noqa: E402
from experiments.walk import PHYSICS, TIMESTEP  # noqa: E402

SIZES = (32, 128, 512, 2048, 4096)
ROUNDS = 5
LONGEST = 10.0
"""Seconds after which no further round begins."""

T = TypeVar("T")


class Case(NamedTuple):
    """What a row of the table is about: duration of an episode in s, and the first so many devices."""

    physics: str
    devices: int
    size: int
    duration: float


class Measured(NamedTuple):
    """What came of it: seconds, and MiB.

    Attributes:
        compiling: time to compile.
        running: time of all episodes, the median of the rounds.
        without_physics: the same where the robot is not stepped.
        compiled_memory: largest memory of the process up to its first rollout.
        peak_memory: largest memory of the process.
        buffers: what the compiled program keeps on all its devices together.
        device_memory: largest memory in use on a device; None where it does not tell, such as a CPU.
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
        physics: What steps the robot, mjx or c.
        devices: How many of the devices share a batch; one and all by default.
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
    finally:  # an interrupt leaves what has been measured by then
        print(f"\n{tables.to_markdown(columns(rows))}")


def measure_sizes(rows: dict[Case, Measured | str], cases: Sequence[Case]) -> None:
    """Measure cases of growing size, each in a new process, until one does not fit."""
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
    """Refuse what cannot be measured.

    Raises:
        UserError: if that is asked for.
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
    """Call a function in a process of its own.

    Raises:
        BrokenProcessPool: if that does not live to answer.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(function, *arguments).result()


def describe_devices() -> tuple[str, int]:
    """Return what kind of devices there are, and how many."""
    return jax.devices()[0].device_kind, jax.device_count()


def measure(case: Case) -> Measured | str:
    """Compile and run a case; return "out of memory" if a device has not enough."""
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
    told = jax.devices()[0].memory_stats() or {}
    device_memory = told.get("peak_bytes_in_use")
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
    """Compile the rollouts of a case; return the program, and what runs it to its end."""
    task, contexts, thetas = walking_batch(case.size, case.duration, physics)
    devices = tuple(jax.devices()[: case.devices])
    batch = (jax.random.key(0), contexts, thetas)
    compiled = roll_out.lower(task, devices, *batch).compile()
    batch = jax.device_put(batch, compiled.input_shardings[0])
    return compiled, lambda: jax.block_until_ready(compiled(*batch))


def _no_physics(*_: Any) -> ControlStep:
    """Return a control step that leaves the robot where it is, all but: XLA plans only what is of use."""

    def control_step(state: RobotState, before: jax.Array, after: jax.Array, speed: jax.Array) -> RobotState:
        told = 1e-9 * (before + after + speed).sum()
        return state._replace(qpos=state.qpos.at[0].add(told))

    return control_step


def _median_seconds(run: Callable[[], Any]) -> float:
    seconds: list[float] = []
    while len(seconds) < ROUNDS and sum(seconds) < LONGEST:
        begin = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - begin)
    return float(np.median(seconds))


def peak_memory() -> float:
    """Return the largest memory that this process has had so far, MiB."""
    status = Path("/proc/self/status")
    # What getrusage tells may be, on Linux, that of the process that started this one.
    if status.exists() and (found := re.search(r"VmHWM:\s*(\d+) kB", status.read_text())):
        return int(found[1]) / 2**10
    unit = 1 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


def columns(rows: Mapping[Case, Measured | str]) -> dict[str, list[str]]:
    """Return the table's columns; a case that could not be measured says why in place of its speed."""
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
    try:
        tyro.cli(main)
    except UserError as error:
        sys.exit(f"error: {error}")

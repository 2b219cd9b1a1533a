"""Set up the process before jax and MuJoCo are imported: devices, threads, compilation cache."""

import _thread
import contextlib
import io
import os
import sys
import threading
from pathlib import Path
from typing import Any

from creps_jax.errors import UserError

# One thread for each device, and small matrix products without the set-up costs of a library for large ones.
# XLA ends the process on an unknown flag: jaxlib 0.9.0 and 0.12.0 know both.
XLA_FLAGS = ("--xla_cpu_multi_thread_eigen=false", "--xla_cpu_experimental_ynn_fusion_type=")


def usable_cores() -> int:
    """Count the processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def cache_folder() -> Path:
    """Return the folder of the compilation cache; it may not exist yet."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "creps_jax" / "jax"


def prepare() -> None:
    """Set the environment variables that jax reads when it is imported; variables of the user are kept.

    One CPU device for each core, each with one thread, steps a batch about twice as fast as one device with
    many threads. The compilation cache saves most of the time for compiling in the next process.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    ours = [flag for flag in XLA_FLAGS if flag.partition("=")[0] not in flags]
    os.environ["XLA_FLAGS"] = " ".join([*flags.split(), *ours])
    if "xla_force_host_platform_device_count" not in flags:
        os.environ.setdefault("JAX_NUM_CPU_DEVICES", str(usable_cores()))
    # Threads of OpenBLAS compete with the threads of the devices: on busy cores the small factorisations of
    # an update were a hundred times slower.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        # If the home folder is not writable there is no cache.
        with contextlib.suppress(OSError, RuntimeError):
            folder = cache_folder()
            folder.mkdir(parents=True, exist_ok=True)
            os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    # jax 0.9 prints many lines about processor features for each cached program.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "0")


def join_processes() -> None:
    """Let this process and its peers share their devices, before jax does anything else.

    Under SLURM, Open MPI and Kubernetes jax needs no settings. Elsewhere set the environment variables
    JAX_COORDINATOR_ADDRESS (host:port of the first process), JAX_NUM_PROCESSES and JAX_PROCESS_ID (from 0).

    Raises:
        UserError: if these are missing, or the other processes cannot be reached.
    """
    import jax

    num, number = (os.environ.get(f"JAX_{name}") for name in ("NUM_PROCESSES", "PROCESS_ID"))
    try:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(
            num_processes=None if num is None else int(num),
            process_id=None if number is None else int(number),
        )
    except (ValueError, RuntimeError) as error:
        raise UserError(
            "cannot join the other processes; JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES, JAX_PROCESS_ID are "
            f"{os.environ.get('JAX_COORDINATOR_ADDRESS')}, {num}, {number}: "
            f"{str(error).splitlines()[0]}"
        ) from error


def import_mjx_quietly() -> None:
    """Import MJX without its messages about a missing Warp.

    Raises:
        UserError: if MuJoCo cannot use the OpenGL that MUJOCO_GL names.
    """
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(ImportError):
            from mujoco import mjx  # noqa: F401
    except (AttributeError, RuntimeError) as error:
        name = os.environ.get("MUJOCO_GL")
        if name is None:
            raise
        raise UserError(
            f"MUJOCO_GL must name an OpenGL that is installed here, egl as a rule, or be unset, got {name!r}"
        ) from error


def keep_interrupts() -> None:
    """Interrupt again if Ctrl-C came in a callback that drops exceptions, such as a finaliser."""
    tell = sys.unraisablehook

    def hook(unraisable: Any) -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            threading.Timer(0.1, _thread.interrupt_main).start()
        else:
            tell(unraisable)

    sys.unraisablehook = hook

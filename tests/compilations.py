"""Count what jax compiles."""

import contextlib

import jax


@contextlib.contextmanager
def count_compilations():
    """Give a list that grows by the seconds of each compilation."""
    compilations = []

    def listen(event, duration, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            compilations.append(duration)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield compilations
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)

"""Seconds to compile a whole run of Online BayesSim: in a fresh process, without and with the persistent cache."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile

from benchmarks.timing import choose_clock, chosen_clock, now

__all__ = ["measure_compilation"]


def measure_compilation() -> tuple[float, float]:
    """Seconds from the call to the compiled program, tracing included: cold, and from the persistent cache."""
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {
            "JAX_COMPILATION_CACHE_DIR": folder,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
        command = [sys.executable, "-W", "ignore", "-m", "benchmarks.compilation", chosen_clock()]
        laps = [
            float(subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout)
            for _ in range(2)
        ]
    return laps[0], laps[1]


def _compile_run() -> float:
    import jax

    from bayessim_jax import online
    from bayessim_jax.engines.simulated import SimulatedTarget
    from bayessim_jax.learning import default_learner
    from bayessim_jax.systems import Balance, CartPole

    system, task = CartPole.create(), Balance()
    setup = online.Setup.create(system, default_learner("cartpole", system, task), task)
    target = SimulatedTarget(system, task, jax.numpy.array([0.5, 0.3]))
    run = jax.jit(online.run, static_argnames="rounds", compiler_options=online.COMPILER_OPTIONS)
    start = now()
    run.lower(jax.random.key(0), setup, target, rounds=30).compile()
    return now() - start


if __name__ == "__main__":
    choose_clock(sys.argv[1])
    print(_compile_run())

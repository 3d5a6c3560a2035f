"""Steps per second of the engines against MuJoCo's C engine and MJX, measured in one run on the same processors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from bayessim_jax.engines.batch import compile_batched, compile_spread, forward_jacobians
from bayessim_jax.engines.fields import Write, find_writes, merge_writes
from bayessim_jax.engines.models import ModelBank
from bayessim_jax.engines.mujoco import MujocoEngine, count_cores
from bayessim_jax.engines.tree import TreeEngine
from benchmarks.mechanisms import CONTACT_MODELS, SMOOTH_MODELS, Mechanism, all_parameters
from benchmarks.timing import Spread, now, stopwatch

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Callable

__all__ = ["compare_engines"]

TARGETS = {"pendulum": 300, "cart-pole": 120, "double pendulum": 120, "3-joint arm": 60, "6-joint arm": 15}
DIRECTIONS = 6
CONTACT_BATCH = 256


@dataclass(frozen=True)
class Problem:
    """A model with θ, and a batch of parameters, initial states and controls."""

    model: mujoco.MjModel
    writes: tuple[Write, ...]
    thetas: np.ndarray
    qpos: np.ndarray
    ctrls: np.ndarray
    substeps: int

    @classmethod
    def draw(cls, mechanism: Mechanism, batch: int, periods: int, paths: list[str] | None = None) -> Problem:
        """θ within 10 % of the model's numbers, random controls, in float32 as all sides get them."""
        model = mechanism.compile()
        paths = all_parameters(model) if paths is None else paths
        writes = merge_writes([find_writes(model, [path], k) for k, path in enumerate(paths)])
        rng = np.random.default_rng(0)
        nominal = np.zeros(len(paths))
        for write in (w for w in writes if not w.follows):
            array = model.opt.gravity if write.field == "gravity" else getattr(model, write.field)
            nominal[write.parameter] = array[write.index] / write.factor
        single = lambda x: x.astype(np.float32)  # noqa: E731
        thetas = single(nominal * rng.uniform(0.9, 1.1, (batch, len(paths))))
        qpos = single(np.tile(model.qpos0, (batch, 1)))
        ctrls = single(rng.uniform(-0.4, 0.4, (batch, periods, model.nu)))
        return cls(model, writes, thetas, qpos, ctrls, mechanism.substeps)

    @property
    def steps(self) -> int:
        """Time steps of the whole batch."""
        return self.ctrls.shape[0] * self.ctrls.shape[1] * self.substeps


def compare_engines(options: Namespace) -> None:
    """Print the three tables as they are measured."""
    print(
        f"MuJoCo {mujoco.__version__} with mujoco.rollout on {count_cores()} threads; jax {jax.__version__}, float32, "
    )
    print(f"{options.steps} steps, every state kept; {options.repeats} repeats, median (range) of paired ratios\n")
    print("| model | θ | batch | tree, steps/s | C engine, steps/s | ratio | target | compile, s | apart |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name in options.models:
        for batch in options.batches:
            _compare_tree(name, Problem.draw(SMOOTH_MODELS[name], batch, options.steps), options.repeats)
    if options.mjx:
        print("\n| model | batch | tree / MJX | MJX, steps/s | MJX compile, s |\n|---|---|---|---|---|")
        for name in options.models:
            _compare_mjx(name, Problem.draw(SMOOTH_MODELS[name], options.mjx, 20), options.repeats)
    print(f"\nForward-mode Jacobian of the last state over {DIRECTIONS} parameters, in forward rollouts\n")
    print("| model | batch | ratio | compile, s |\n|---|---|---|---|")
    for name in options.models:
        _compare_jacobian(name, Problem.draw(SMOOTH_MODELS[name], 256, options.steps), options.repeats)
    print(f"\nC engine in compiled code, batch {CONTACT_BATCH}: parts of the throughput of bare mujoco.rollout\n")
    print("| model | bare, steps/s | replay in one call | scan, recorded controls | scan, policy acting |")
    print("|---|---|---|---|---|")
    for name, mechanism in CONTACT_MODELS.items():
        _compare_callback(name, mechanism, options.repeats)


def _bare(problem: Problem) -> Callable[[], np.ndarray]:
    """`mujoco.rollout` on all processors, with its models, buffers and pool made beforehand, and its checks off."""
    model, periods = problem.model, problem.ctrls.shape[1] * problem.substeps
    models = ModelBank(model, problem.writes).batch(problem.thetas)
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    data = [mujoco.MjData(model) for _ in range(count_cores())]
    initial = np.zeros((len(models), mujoco.mj_stateSize(model, kind)))
    initial[:, 1 : 1 + model.nq] = problem.qpos
    states = np.empty((len(models), periods, initial.shape[1]))
    ctrls = np.repeat(problem.ctrls.astype(np.float64), problem.substeps, 1)
    pool = rollout.Rollout(nthread=len(data))

    def run() -> np.ndarray:
        pool.rollout(models, data, initial, ctrls, nstep=periods, skip_checks=True, state=states)
        return states

    return run


def _paired(ours: Callable[[], Any], theirs: Callable[[], Any], repeats: int) -> tuple[Spread, Spread, Spread]:
    """Seconds of both, one after the other, and their ratio, theirs over ours; short calls many in a row."""
    both: list[tuple[float, float]] = []
    calls = [max(1, round(0.2 / max(stopwatch(call)[0], 1e-6))) for call in (ours, theirs)]
    for _ in range(repeats):
        laps = []
        for call, count in zip((ours, theirs), calls, strict=True):
            start = now()
            for _ in range(count):
                jax.block_until_ready(call())
            laps.append((now() - start) / count)
        both.append((laps[0], laps[1]))
    a, b = zip(*both, strict=True)
    return Spread.of(a), Spread.of(b), Spread.of([y / x for x, y in both])


def _rates(steps: int, seconds: Spread) -> Spread:
    return Spread.of([steps / s for s in seconds.values])


def _trajectory(engine: Any, substeps: int) -> Callable[..., Any]:
    def run(theta: Any, qpos: Any, ctrls: Any) -> Any:
        start = engine.init(theta, qpos, jnp.zeros(engine.model.nv, qpos.dtype))
        return engine.replay(theta, start, ctrls, steps=substeps)

    return run


def _compiled_tree(problem: Problem) -> tuple[float, Callable[[], Any]]:
    engine = TreeEngine(problem.model, problem.writes)
    start = now()
    compiled, placed = compile_batched(
        _trajectory(engine, problem.substeps), problem.thetas, problem.qpos, problem.ctrls, out_axes=-1
    )
    seconds = now() - start
    return seconds, lambda: jax.block_until_ready(compiled(*placed))


def _compare_tree(name: str, problem: Problem, repeats: int) -> None:
    seconds, ours = _compiled_tree(problem)
    theirs = _bare(problem)
    a, b, ratio = _paired(ours, theirs, repeats)
    nq, states = problem.model.nq, theirs()
    apart = max(np.abs(np.asarray(ours().qpos[k]).T - states[:, :, 1 + k]).max() for k in range(nq))
    batch, count = problem.thetas.shape
    print(
        f"| {name} | {count} | {batch} | {_rates(problem.steps, a).median:.3g} | {_rates(problem.steps, b).median:.3g} "
        f"| {ratio} | {TARGETS[name]} | {seconds:.2g} | {apart:.0e} |",
        flush=True,
    )


def _compare_mjx(name: str, problem: Problem, repeats: int) -> None:
    from bayessim_jax.engines.mjx import MjxEngine

    _, ours = _compiled_tree(problem)
    run = jax.jit(jax.vmap(_trajectory(MjxEngine(problem.model, problem.writes), problem.substeps)))
    inputs = tuple(jnp.asarray(x) for x in (problem.thetas, problem.qpos, problem.ctrls))
    start = now()
    compiled = run.lower(*inputs).compile()
    seconds = now() - start
    _, b, ratio = _paired(ours, lambda: jax.block_until_ready(compiled(*inputs)), repeats)
    rate = _rates(problem.steps, b).median
    print(f"| {name} | {len(problem.thetas)} | {ratio} | {rate:.3g} | {seconds:.2g} |", flush=True)


def _compare_jacobian(name: str, problem: Problem, repeats: int) -> None:
    engine = TreeEngine(problem.model, problem.writes)
    trajectory = _trajectory(engine, problem.substeps)
    directions = jnp.eye(problem.thetas.shape[1], dtype=np.float32)[:DIRECTIONS]

    def last(theta: Any, qpos: Any, ctrls: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf[-1], trajectory(theta, qpos, ctrls))

    inputs = problem.thetas, problem.qpos, problem.ctrls
    forward, placed = compile_batched(last, *inputs)
    start = now()
    derivative, _ = compile_spread(forward_jacobians(last, directions), *inputs, out_axes=(0, 1))
    seconds = now() - start
    _, _, ratio = _paired(
        lambda: jax.block_until_ready(forward(*placed)), lambda: jax.block_until_ready(derivative(*placed)), repeats
    )
    print(f"| {name} | {len(problem.thetas)} | {ratio} | {seconds:.2g} |", flush=True)


def _compare_callback(name: str, mechanism: Mechanism, repeats: int) -> None:
    problem = Problem.draw(mechanism, CONTACT_BATCH, 25, [f"body/{mechanism.compile().body(1).name}/mass"])
    engine, bare = MujocoEngine(problem.model, problem.writes), _bare(problem)
    inputs = tuple(jnp.asarray(x) for x in (problem.thetas, problem.qpos, problem.ctrls))
    weights = [0.1 * np.random.default_rng(1).normal(size=s).astype(np.float32) for s in _layers(problem.model)]

    def recorded(theta: Any, qpos: Any, ctrls: Any) -> Any:
        start = engine.init(theta, qpos, jnp.zeros(engine.model.nv))

        def period(state: Any, ctrl: Any) -> Any:
            after = engine.step(theta, state, ctrl, steps=problem.substeps)
            return after, after

        return jax.lax.scan(period, start, ctrls)[1]

    def acting(theta: Any, qpos: Any, ctrls: Any) -> Any:
        start = engine.init(theta, qpos, jnp.zeros(engine.model.nv))

        def period(state: Any, ctrl: Any) -> Any:
            x = jnp.concatenate([state.qpos, state.qvel])
            for weight in weights[:-1]:
                x = jnp.tanh(x @ weight)
            after = engine.step(theta, state, ctrl + 0.01 * (x @ weights[-1]), steps=problem.substeps)
            return after, after

        return jax.lax.scan(period, start, ctrls)[1]

    parts, rate = [], None
    for function in (_trajectory(engine, problem.substeps), recorded, acting):
        compiled = jax.jit(jax.vmap(function)).lower(*inputs).compile()
        _, b, part = _paired(lambda c=compiled: jax.block_until_ready(c(*inputs)), bare, repeats)
        parts.append(part)
        rate = _rates(problem.steps, b).median
    print(f"| {name} | {rate:.3g} | {parts[0]} | {parts[1]} | {parts[2]} |", flush=True)


def _layers(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """A policy of two hidden layers of 64."""
    return [(model.nq + model.nv, 64), (64, 64), (64, model.nu)]

"""Fetch Push: the simulator against bare `mujoco.rollout`, training against Stable-Baselines3 with its HER buffer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout as bare

from bayessim_jax.beliefs import Uniform
from bayessim_jax.engines.mujoco import PHYSICS
from bayessim_jax.learning import Her, default_learner
from bayessim_jax.systems import lookup
from bayessim_jax.systems.fetch import INPUTS, SUBSTEPS, Fetch
from benchmarks.timing import Spread, now, stopwatch

if TYPE_CHECKING:
    from argparse import Namespace

__all__ = ["compare_fetch"]


def compare_fetch(options: Namespace) -> None:
    """Print steps per second of simulation and of training, on both sides, and their ratios."""
    entry = lookup("fetch_push")
    system: Any = entry.system()
    simulations = [_simulate(system, options.batch, options.steps, r) for r in range(options.repeats)]
    mine, theirs = (Spread.of(column) for column in zip(*simulations, strict=True))
    ratio = Spread.of([a / b for a, b in simulations])
    print(
        f"simulation, {options.batch} worlds: {mine} control steps/s, mujoco.rollout {theirs}, ratio {ratio}",
        flush=True,
    )

    learner = default_learner("fetch_push", system, entry.task())
    assert isinstance(learner, Her)
    belief, played = Uniform(system.parameters), learner.iterations * learner.envs * learner.horizon
    step = jax.jit(lambda key, state: learner.step(key, state, belief)[0])
    state = step(jax.random.key(0), jax.jit(learner.init)(jax.random.key(1)))
    training = [played / stopwatch(step, jax.random.key(r), state)[0] for r in range(options.repeats)]
    updates = learner.updates * learner.batch / (learner.envs * learner.horizon)
    print(f"training: {Spread.of(training)} control steps/s, {updates:.0f} transitions replayed for each", flush=True)
    if options.peer_steps:
        from benchmarks.peers import choose_threads, require_peers

        require_peers("torch", "stable_baselines3")
        print(f"threads of PyTorch: {choose_threads()}", flush=True)
        peer = [_train_peer(options.peer_steps, updates, r) for r in range(options.repeats)]
        print(f"Stable-Baselines3, as many replayed: {Spread.of([p[0] for p in peer])} control steps/s")
        print(f"Stable-Baselines3, as it comes:      {Spread.of([p[1] for p in peer])} control steps/s")
        for name, column in (("as many replayed", 0), ("as it comes", 1)):
            ratio = Spread.of([a / p[column] for a, p in zip(training, peer, strict=True)])
            print(f"times faster, {name}: {ratio}")


def _simulate(system: Fetch, batch: int, steps: int, seed: int) -> tuple[float, float]:
    """Control steps per second here, in a compiled scan, and of the C engine by itself over the same movements."""
    keys = jax.random.split(jax.random.key(seed), batch)
    thetas = jnp.linspace(0.2, 1.9, batch)[:, None]
    moves = jax.random.uniform(keys[0], (batch, steps, 4), minval=-1.0, maxval=1.0)
    begun = jax.vmap(system.reset)(keys, thetas)

    @jax.jit
    @jax.vmap
    def run(theta: Any, state: Any, moves: Any) -> Any:
        def step(state: Any, move: Any) -> Any:
            after = system.step(theta, state, move)
            mocap = jnp.concatenate([state.hand[6:9] + 0.05 * move[:3], state.hand[9:13] + jnp.array([1.0, 0, 1, 0])])
            return after, (system.observe(theta, after), mocap)

        return jax.lax.scan(step, state, moves)[1]

    _, mocap = jax.block_until_ready(run(thetas, begun, moves))
    mine, _ = stopwatch(run, thetas, begun, moves)

    engine = system.engine
    models = engine.bank.batch(np.asarray(thetas))
    states = np.ascontiguousarray(begun.physics.physics).view(np.float64)
    controls = np.repeat(np.asarray(mocap, np.float64), SUBSTEPS, axis=1)
    data = [mujoco.MjData(engine.model) for _ in range(engine.threads)]
    room = np.empty((batch, steps * SUBSTEPS, mujoco.mj_stateSize(engine.model, PHYSICS)))
    with bare.Rollout(nthread=engine.threads) as pool:
        start = now()
        pool.rollout(
            models, data, states, controls, control_spec=INPUTS, nstep=steps * SUBSTEPS, skip_checks=True, state=room
        )
        seconds = now() - start
    return batch * steps / mine, batch * steps / seconds


def _train_peer(steps: int, replayed: float, seed: int) -> tuple[float, float]:
    """Control steps per second of DDPG with hindsight on `FetchPush-v4`.

    The first figure is with as many transitions replayed for each step as here, in batches of as many; the second with
    one gradient step for each, as it is by default.
    """
    import gymnasium
    from stable_baselines3 import DDPG, HerReplayBuffer

    from bayessim_jax.engines.gymnasium import require_robotics

    require_robotics()
    found = []
    for every in (max(1, round(256 / replayed)), 1):
        env = gymnasium.make("gymnasium_robotics:FetchPush-v4")
        model = DDPG(
            "MultiInputPolicy",
            env,
            replay_buffer_class=HerReplayBuffer,
            replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
            policy_kwargs={"net_arch": [128, 128, 128]},
            batch_size=256,
            train_freq=every,
            gradient_steps=1,
            learning_starts=500,
            seed=seed,
            device="cpu",
        )
        model.learn(600)
        start = now()
        model.learn(steps, reset_num_timesteps=False)
        found.append(steps / (now() - start))
    return found[0], found[1]

"""Gymnasium environments as targets: stepped on the host, from inside compiled code."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import itertools
import threading
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.custom_batching import custom_vmap
from jax.experimental import io_callback
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from bayessim_jax.contracts import Policy, Recording
from bayessim_jax.rollout import assemble
from bayessim_jax.spelling import find_named

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = [
    "GYMNASIUM",
    "GymnasiumTarget",
    "find_fetch_friction",
    "gymnasium_target",
    "hide_acrobot",
    "hide_cartpole",
    "hide_fetch",
    "hide_hopper",
    "hide_pendulum",
    "require_robotics",
]


def hide_cartpole(env: Any, theta: np.ndarray) -> None:
    """Give `CartPole-v1` a pole of half-length θ₁ (m) and mass θ₂ (kg)."""
    env.length, env.masspole = float(theta[0]), float(theta[1])
    env.total_mass = env.masspole + env.masscart
    env.polemass_length = env.masspole * env.length


def hide_pendulum(env: Any, theta: np.ndarray) -> None:
    """Give `Pendulum-v1` a rod of length θ₁ (m) and mass θ₂ (kg)."""
    env.l, env.m = float(theta[0]), float(theta[1])


def hide_acrobot(env: Any, theta: np.ndarray) -> None:
    """Give `Acrobot-v1` links of masses θ₁, θ₂ (kg) and lengths θ₃, θ₄ (m), centres of mass half-way."""
    env.LINK_MASS_1, env.LINK_MASS_2, env.LINK_LENGTH_1, env.LINK_LENGTH_2 = (float(t) for t in theta)
    env.LINK_COM_POS_1, env.LINK_COM_POS_2 = env.LINK_LENGTH_1 / 2, env.LINK_LENGTH_2 / 2


def find_fetch_friction(model: Any) -> tuple[int, int]:
    """The geoms of a Fetch model that slide on each other: the object's, and the table's."""
    return int(model.geom("object0").id), int(model.body("table0").geomadr[0])


def hide_fetch(env: Any, theta: np.ndarray) -> None:
    """Give `FetchPush-v4` or `FetchSlide-v4` the sliding friction θ₁ between object and table, on both of them."""
    for geom in find_fetch_friction(env.model):
        env.model.geom_friction[geom, 0] = float(theta[0])


def hide_hopper(env: Any, theta: np.ndarray) -> None:
    """Give `Hopper-v5` the sliding friction θ₁ on every geom, the floor's included."""
    env.model.geom_friction[:, 0] = float(theta[0])


def require_robotics() -> Path:
    """Where gymnasium-robotics is installed; `ValueError` in one line where it is not."""
    if importlib.util.find_spec("gymnasium_robotics") is None:
        raise ValueError("Fetch needs gymnasium-robotics: pip install 'bayessim-jax[fetch]' and try again.")
    with contextlib.redirect_stderr(io.StringIO()):  # it prints news of other environments
        import gymnasium_robotics
    return Path(str(gymnasium_robotics.__file__)).parent


GYMNASIUM: dict[str, tuple[str, Callable[[Any, np.ndarray], None], float]] = {
    "cartpole": ("CartPole-v1", hide_cartpole, 0.02),
    "pendulum": ("Pendulum-v1", hide_pendulum, 0.05),
    "acrobot": ("Acrobot-v1", hide_acrobot, 0.2),
    "hopper": ("Hopper-v5", hide_hopper, 0.008),
    "fetch_push": ("gymnasium_robotics:FetchPush-v4", hide_fetch, 0.04),
    "fetch_slide": ("gymnasium_robotics:FetchSlide-v4", hide_fetch, 0.04),
}
"""For each system: the environment, how θ is put into it, and its control period in s."""


SHOWN = ("observation", "desired_goal")


class _Pool:
    """Environments of one kind on the host: those in an episode, by token, and those that wait for the next one."""

    def __init__(self, env_id: str, configure: Callable[[Any, np.ndarray], None]) -> None:
        self.make = partial(gymnasium.make, env_id, disable_env_checker=True)
        self.configure = configure
        self.waiting: list[Any] = []
        self.acting: dict[int, Any] = {}
        self.tokens = itertools.cycle(range(1, 2**31 - 1))
        self.made = 0
        self.lock = threading.Lock()
        self._add()
        self.discrete = isinstance(self.waiting[0].action_space, gymnasium.spaces.Discrete)
        self.channels = _count(self.waiting[0].observation_space)

    def reset(self, seeds: Any, thetas: Any) -> np.ndarray:
        """Begin episodes: (seed) and θ give (token, bits of the first observation), for any leading batch axes."""
        seeds, thetas = np.asarray(seeds)[..., 0], np.asarray(thetas)
        result = np.empty((*seeds.shape, 1 + self.channels), np.int32)
        for index in np.ndindex(seeds.shape):
            with self.lock:
                if not self.waiting:
                    self._add()
                env, token = self.waiting.pop(), next(self.tokens)
            self.configure(env.unwrapped, thetas[index])
            observation, _ = env.reset(seed=int(seeds[index]))
            self.acting[token] = env
            result[index][0] = token
            result[index][1:].view(np.float32)[:] = _flat(observation)
        return result

    def step(self, packed: Any) -> np.ndarray:
        """Advance episodes: (token, last, bits of the action) gives (observation, reward, ended), likewise batched."""
        packed = np.asarray(packed)
        batch = packed.shape[:-1]
        packed = packed.reshape(-1, packed.shape[-1])
        actions = packed[:, 2:].view(np.float32)
        result = np.zeros((len(packed), self.channels + 2), np.float32)
        for (token, last), action, sound, row in zip(
            packed[:, :2].tolist(), actions, np.isfinite(actions).all(-1).tolist(), result, strict=True
        ):
            env = self.acting.get(token)
            if env is None:
                row[-1] = 1.0
                continue
            if sound:
                chosen = round(action.item()) if self.discrete else action
                observation, row[-2], terminated, truncated, _ = env.step(chosen)
                row[:-2] = _flat(observation)
                ended = terminated or truncated
            else:
                row[:], ended = np.nan, True
            row[-1] = ended
            if ended or last:
                self.waiting.append(self.acting.pop(token))
        return result.reshape(*batch, -1)

    def _add(self) -> None:
        self.waiting.append(self.make())
        self.made += 1


def _count(space: Any) -> int:
    """Numbers in `_flat` of what such a space holds."""
    if isinstance(space, gymnasium.spaces.Dict):
        return sum(_count(space[name]) for name in SHOWN)
    return int(np.prod(space.shape or ()))


def _flat(observation: Any) -> np.ndarray:
    """An observation in a row; of a goal environment's the goal comes last, and what is achieved is left out."""
    parts = [observation[name] for name in SHOWN] if isinstance(observation, dict) else [observation]
    return np.concatenate([np.ravel(part) for part in parts])


@cache
def _pool(env_id: str, configure: Callable[[Any, np.ndarray], None]) -> _Pool:
    return _Pool(env_id, configure)


def _on_host(function: Callable[..., np.ndarray], width: int, dtype: Any) -> Callable[..., Any]:
    """Call `function` of vectors from compiled code; under `jax.vmap` one call carries the whole batch."""

    @custom_vmap
    def call(*vectors: Any) -> Any:
        return io_callback(function, jax.ShapeDtypeStruct((*vectors[0].shape[:-1], width), dtype), *vectors)

    @call.def_vmap
    def _(size: int, batched: list[bool], *vectors: Any) -> Any:
        spread = (v if b else jnp.broadcast_to(v, (size, *v.shape)) for v, b in zip(vectors, batched, strict=True))
        return call(*spread), True

    return call


@struct.dataclass
class GymnasiumTarget:
    """A Gymnasium environment with hidden parameters θ*, y = environment's observation + noise · ε, ε ~ N(0, I).

    The environment acts on the host, in callbacks that depend on each other through their data alone, so `record`
    may stand inside `jax.jit`, `jax.lax.scan` and `jax.vmap`: each episode has an environment of its own, seeded from
    its key and given back at the episode's end. θ* is a leaf: every episode of a batch can hide another one.
    """

    theta: Float[Array, " d"]
    noise: Float[Array, " obs"]
    dt: float = struct.field(pytree_node=False)
    env_id: str = struct.field(pytree_node=False)
    configure: Callable[[Any, np.ndarray], None] = struct.field(pytree_node=False)

    @classmethod
    def create(
        cls,
        env_id: str,
        configure: Callable[[Any, np.ndarray], None],
        theta: Float[ArrayLike, " d"],
        noise: float | Float[ArrayLike, " obs"],
        dt: float,
    ) -> GymnasiumTarget:
        """Make the target of `env_id`; `configure(env, θ)` puts θ into the unwrapped environment before a reset."""
        pool = _pool(env_id, configure)
        noise = jnp.asarray(noise, float)
        if noise.shape not in ((), (pool.channels,)):
            raise ValueError(
                f"noise has shape {noise.shape}; {env_id} has {pool.channels} observations: give one number or "
                f"{pool.channels}."
            )
        return cls(jnp.asarray(theta, float), jnp.broadcast_to(noise, (pool.channels,)), dt, env_id, configure)

    @partial(jax.jit, static_argnames="steps")
    def record(self, key: PRNGKeyArray, policy: Policy, steps: int) -> Recording:
        """Let the policy act for at most `steps` control periods and return what was measured."""
        pool = _pool(self.env_id, self.configure)
        reset_key, noise_key, act_key = jax.random.split(key, 3)
        noise = self.noise * jax.random.normal(noise_key, (steps + 1, pool.channels))
        seed = jax.random.bits(reset_key, (), jnp.uint32)
        begun = _on_host(pool.reset, 1 + pool.channels, jnp.int32)(seed[None], self.theta)
        token, first = begun[0], jax.lax.bitcast_convert_type(begun[1:], jnp.float32) + noise[0]
        advance = _on_host(pool.step, pool.channels + 2, jnp.float32)

        def step(carry: Any, x: Any) -> Any:
            observation, memory, ended = carry
            key, noise, last = x
            action, memory = policy.act(key, memory, observation)
            bits = jax.lax.bitcast_convert_type(action.astype(jnp.float32), jnp.int32)
            head = jnp.stack([jnp.where(ended, 0, token), last.astype(jnp.int32)])
            result = advance(jnp.concatenate([head, bits]))
            measured = result[:-2] + noise
            return (measured, memory, ended | (result[-1] != 0)), (measured, action, result[-2], ~ended)

        last = jnp.arange(steps) == steps - 1
        carry = (first, policy.init(), jnp.array(False))
        _, (later, actions, rewards, valid) = jax.lax.scan(
            step, carry, (jax.random.split(act_key, steps), noise[1:], last)
        )
        return assemble(self.dt, jnp.concatenate([first[None], later]), actions, rewards, valid)


def gymnasium_target(
    name: str, theta: Float[ArrayLike, " d"], noise: float | Float[ArrayLike, " obs"] = 0.01
) -> GymnasiumTarget:
    """The Gymnasium environment behind a system of this package, or `ValueError` with the near miss."""
    env_id, configure, dt = find_named(name, GYMNASIUM, "no Gymnasium environment for the system")
    if configure is hide_fetch:
        require_robotics()
    return GymnasiumTarget.create(env_id, configure, theta, noise, dt)

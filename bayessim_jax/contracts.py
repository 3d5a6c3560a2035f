"""The contracts: what every part of the package promises the others.

Read this page first. Everything is written for one trajectory and one θ; callers batch with `jax.vmap`. States are
`flax.struct` dataclasses that hold arrays only, so every one of them is a legal `jax.lax.scan` carry. Keys are
arguments and come first. State is what the next step needs; Info is what a person wants to see.
"""

from __future__ import annotations

from typing import Any, Protocol, TypeVar, runtime_checkable

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

__all__ = [
    "Belief",
    "Box",
    "Discrete",
    "Estimator",
    "GoalTask",
    "Learner",
    "Policy",
    "Recording",
    "Restartable",
    "Scalar",
    "System",
    "Target",
    "Task",
]

Scalar = Float[Array, ""]
S = TypeVar("S")
L = TypeVar("L")
E = TypeVar("E")


@struct.dataclass
class Box:
    """A box in ℝᵈ with a name and a unit for each axis: the space of θ, of actions or of observations."""

    low: Float[Array, " d"]
    high: Float[Array, " d"]
    names: tuple[str, ...] = struct.field(pytree_node=False)
    units: tuple[str, ...] = struct.field(pytree_node=False)

    @classmethod
    def create(cls, **axes: tuple[float, float, str]) -> Box:
        """Build a box from `name=(low, high, unit)`, and refuse one that is empty along an axis."""
        for name, (low, high, _) in axes.items():
            if not low < high:
                raise ValueError(f"Box axis {name!r}: low {low} must be below high {high}; swap or widen the bounds.")
        return cls(
            low=jnp.array([a[0] for a in axes.values()], dtype=float),
            high=jnp.array([a[1] for a in axes.values()], dtype=float),
            names=tuple(axes),
            units=tuple(a[2] for a in axes.values()),
        )

    @property
    def size(self) -> int:
        """Number of axes, d."""
        return len(self.names)

    @property
    def width(self) -> Float[Array, " d"]:
        """High minus low, in each axis' unit."""
        return self.high - self.low

    def contains(self, point: Float[Array, " d"]) -> Bool[Array, ""]:
        """Whether a point lies inside or on the boundary."""
        return jnp.all((point >= self.low) & (point <= self.high))


@struct.dataclass
class Discrete:
    """`count` actions. An action is still a float vector of length 1 that holds the index 0 … count − 1."""

    count: int = struct.field(pytree_node=False)
    names: tuple[str, ...] = struct.field(pytree_node=False, default=("action",))
    units: tuple[str, ...] = struct.field(pytree_node=False, default=("",))

    @property
    def size(self) -> int:
        """Length of the action vector: 1."""
        return 1


@struct.dataclass
class Recording:
    """One trajectory of `steps` transitions, measured or simulated, padded to a fixed length.

    Row t of `observations` is what was measured at `times[t]` (s), in the system's units; `actions[t]` is held from
    `times[t]` to `times[t + 1]`. `valid[t]` says that transition t, from row t to row t + 1, happened: it is false
    after the episode ended, in gaps and from the first non-finite number on, and every padded entry is zero.
    `diverged` says that the simulation produced a non-finite number: such a recording is counted and takes part in
    nothing. `rollout.assemble` makes one of arrays.
    """

    times: Float[Array, " rows"]
    observations: Float[Array, "rows obs"]
    actions: Float[Array, "steps act"]
    rewards: Float[Array, " steps"]
    valid: Bool[Array, " steps"]
    diverged: Bool[Array, ""]


@runtime_checkable
class System(Protocol[S]):
    """A simulator whose parameters θ are an argument: x' = f(θ, x, u), y = h(θ, x) + noise · ε, ε ~ N(0, I).

    It has no reward: inference needs none. Random resets and the standard deviation of the observation noise belong
    to the description of the system, because without them a likelihood can be made as large as one likes.
    """

    parameters: Box
    actions: Box | Discrete
    observations: Box
    noise: Float[Array, " obs"]
    """Standard deviation of the additive Gaussian sensor noise, one for each observation, in its unit."""
    dt: float
    """One control period, s."""

    def reset(self, key: PRNGKeyArray, theta: Float[Array, " d"]) -> S:
        """Draw an initial state."""
        ...

    def step(self, theta: Float[Array, " d"], state: S, action: Float[Array, " act"]) -> S:
        """Advance the state by one control period."""
        ...

    def observe(self, theta: Float[Array, " d"], state: S) -> Float[Array, " obs"]:
        """What the sensors show of a state, before noise."""
        ...


@runtime_checkable
class Restartable(System[S], Protocol[S]):
    """A system that can start from what its sensors show: what a planner, or a replay of a recording, begins with."""

    def restart(self, theta: Float[Array, " d"], observation: Float[Array, " obs"]) -> S:
        """A state that shows this observation; what the sensors do not see of it is at rest."""
        ...


@runtime_checkable
class Task(Protocol[S]):
    """What the controller is for: a reward for each transition, and when an episode ends."""

    steps: int
    """Longest episode, in control periods (the time limit; not a termination)."""

    def reward(self, state: S, action: Float[Array, " act"], next_state: S) -> Scalar:
        """Reward r(x, u, x')."""
        ...

    def terminated(self, state: S) -> Bool[Array, ""]:
        """Whether the episode ends in this state."""
        ...


@runtime_checkable
class GoalTask(Task[S], Protocol[S]):
    """A task with a goal that each episode draws: it is a part of the observation, and what is paid is known for any.

    Episodes last the whole of `steps`: such a task never terminates.
    """

    goal: tuple[int, ...]
    """Channels of the observation that say what is asked for."""
    achieved: tuple[int, ...]
    """Channels that say what is the case, in the same order and units."""

    def pay(self, achieved: Float[Array, " goal"], goal: Float[Array, " goal"]) -> Scalar:
        """Reward of a transition after which `achieved` is the case, had `goal` been asked for."""
        ...


@runtime_checkable
class Policy(Protocol):
    """Anything that acts: a network, a planner, a replayed log. A pytree, so that it can be traced and batched."""

    def init(self) -> Any:
        """Memory at the start of an episode, a pytree of arrays (`()` where there is none)."""
        ...

    def act(
        self, key: PRNGKeyArray, memory: Any, observation: Float[Array, " obs"]
    ) -> tuple[Float[Array, " act"], Any]:
        """Choose an action, and the memory for the next step."""
        ...


@runtime_checkable
class Belief(Protocol):
    """A distribution over θ in raw units. Prior, proposal and posterior are one type."""

    def sample(self, key: PRNGKeyArray) -> Float[Array, " d"]:
        """One draw of θ."""
        ...

    def log_prob(self, theta: Float[Array, " d"]) -> Scalar:
        """Normalized log density in raw units of θ; −∞ outside the support."""
        ...


@runtime_checkable
class Estimator(Protocol[E]):
    """Learns q(θ | recordings) from simulations, θ in raw units drawn from a proposal.

    A posterior is conditioned on a set of recordings that share θ; `use` says which of them count.
    """

    def init(self, key: PRNGKeyArray, example: Recording, d: int) -> E:
        """Random weights for recordings shaped like `example` (leading axis: the set) and `d` parameters."""
        ...

    def fit(
        self,
        key: PRNGKeyArray,
        state: E,
        thetas: Float[Array, "n d"],
        recordings: Recording,
        weights: Float[Array, " n"],
        draws: Int[Array, " n"] | None = None,
    ) -> tuple[E, Any]:
        """Continue from `state` and maximize Σ wᵢ log q(θᵢ | recordingᵢ); a weight of zero switches a pair off.

        `draws` numbers the draw of θ that a pair is of, where several pairs share one; else each has its own.
        """
        ...

    def calibrate(
        self,
        key: PRNGKeyArray,
        state: E,
        thetas: Float[Array, "n d"],
        recordings: Recording,
        observed: Recording,
        use: Bool[Array, " set"],
        box: Box,
        correct: bool = True,
    ) -> tuple[E, Any, Any]:
        """Correct the posterior of sets on sets that were never trained on (leading axes of recordings: n, set).

        The correction is for sets like `observed`; `use` says which recordings count, in it and in the others. `box` is
        the prior's support, to which posteriors are cut before they are judged. Without `correct` the posterior is only
        judged. Info holds `coverage50`, `coverage90`, `overconfident` and `collapsed`; after it stands the posterior of
        `observed`.
        """
        ...

    def posterior(self, state: E, recordings: Recording, use: Bool[Array, " set"]) -> Any:
        """The Gaussian mixture q(θ | recordings in use) under the proposal of the last fit, for one set."""
        ...


@runtime_checkable
class Learner(Protocol[L]):
    """Improves a policy against a belief: θ is redrawn from it at every episode."""

    def init(self, key: PRNGKeyArray) -> L:
        """Random weights, an empty replay buffer."""
        ...

    def step(self, key: PRNGKeyArray, state: L, belief: Belief) -> tuple[L, Any]:
        """One round of improvement.

        Info holds at least `return_mean`, `nonfinite` (transitions that were masked) and `skipped` (updates that were
        not taken), both because a number was not finite.
        """
        ...

    def policy(self, state: L, deterministic: bool = False) -> Policy:
        """The current policy: stochastic to explore, deterministic to be judged."""
        ...


@runtime_checkable
class Target(Protocol):
    """The machine that is to be controlled, real or standing in for it. Its θ is hidden from everything else."""

    def record(self, key: PRNGKeyArray, policy: Policy, steps: int) -> Recording:
        """Let the policy act for at most `steps` control periods and return what was measured."""
        ...

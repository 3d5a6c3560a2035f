"""Action distributions: what a policy network's outputs mean.

A head turns `outputs` numbers into a distribution over raw actions and a raw action into the vector that a system
takes. Noise is an argument, so that a learner can draw it for a whole round at once.
"""

from __future__ import annotations

from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from bayessim_jax.chance import normal
from bayessim_jax.contracts import Box, Discrete, Scalar

__all__ = [
    "Actor",
    "Categorical",
    "Explorer",
    "Gaussian",
    "Head",
    "SquashedGaussian",
    "choose_head",
]

_HALF_LOG_2PI = 0.9189385332046727
_LOG_2 = 0.6931471805599453


class Actor(Protocol):
    """Makes raw actions a of network outputs p: what it takes to act."""

    @property
    def outputs(self) -> int:
        """Network outputs it takes."""
        ...

    @property
    def chances(self) -> int:
        """Numbers of noise that it makes an action of."""
        ...

    def noise(self, uniform: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Noise from uniform numbers in (0, 1), one from each."""
        ...

    def sample(self, p: Float[Array, " outputs"], noise: Float[Array, " chances"]) -> Float[Array, " act"]:
        """A raw action."""
        ...

    def mode(self, p: Float[Array, " outputs"]) -> Float[Array, " act"]:
        """The most probable raw action."""
        ...

    def action(self, raw: Float[Array, " act"]) -> Float[Array, " act"]:
        """The vector that the system takes, in its units."""
        ...


class Head(Actor, Protocol):
    """A distribution over raw actions a, given network outputs p: what it takes to learn by its density."""

    def log_prob(self, p: Float[Array, " outputs"], raw: Float[Array, " act"]) -> Scalar:
        """Log density (or mass) of a raw action."""
        ...

    def entropy(self, p: Float[Array, " outputs"]) -> Scalar:
        """Entropy in nats."""
        ...


@struct.dataclass
class Categorical:
    """P(a) ∝ exp pₐ over indices 0 … count − 1."""

    count: int = struct.field(pytree_node=False)

    @property
    def outputs(self) -> int:
        """One logit for each action."""
        return self.count

    @property
    def chances(self) -> int:
        """One number for each index."""
        return self.count

    def noise(self, uniform: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Gumbel numbers, −log(−log uniform)."""
        return -jnp.log(-jnp.log(uniform))

    def sample(self, p: Float[Array, " count"], noise: Float[Array, " count"]) -> Float[Array, " 1"]:
        """The index of the largest p + noise."""
        return self.mode(p + noise)

    def mode(self, p: Float[Array, " count"]) -> Float[Array, " 1"]:
        """The index of the largest logit."""
        return jnp.argmax(p, -1, keepdims=True).astype(p.dtype)

    def log_prob(self, p: Float[Array, " count"], raw: Float[Array, " 1"]) -> Scalar:
        """Log softmax at the index."""
        return jnp.sum(jax.nn.log_softmax(p) * (raw == jnp.arange(self.count)))

    def entropy(self, p: Float[Array, " count"]) -> Scalar:
        """−Σ P log P, in nats."""
        return -jnp.sum(jax.nn.softmax(p) * jax.nn.log_softmax(p))

    def action(self, raw: Float[Array, " 1"]) -> Float[Array, " 1"]:
        """The index itself."""
        return raw


@struct.dataclass
class Gaussian:
    """a ~ N(mean, exp(2 s)) in units of the box's half-width about its centre, clipped to the box when it acts.

    The network's outputs are (mean, s).
    """

    box: Box

    @property
    def outputs(self) -> int:
        """Mean and log standard deviation of each axis."""
        return 2 * self.box.size

    @property
    def chances(self) -> int:
        """One number for each axis."""
        return self.box.size

    def noise(self, uniform: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Standard normal numbers."""
        return normal(uniform)

    def sample(self, p: Float[Array, " outputs"], noise: Float[Array, " act"]) -> Float[Array, " act"]:
        """Mean plus scaled noise, not yet clipped."""
        mean, log_std = _split(p)
        return mean + jnp.exp(log_std) * noise

    def mode(self, p: Float[Array, " outputs"]) -> Float[Array, " act"]:
        """The mean."""
        return _split(p)[0]

    def log_prob(self, p: Float[Array, " outputs"], raw: Float[Array, " act"]) -> Scalar:
        """Log density of the action before it was clipped."""
        mean, log_std = _split(p)
        return jnp.sum(-0.5 * ((raw - mean) * jnp.exp(-log_std)) ** 2 - log_std - _HALF_LOG_2PI)

    def entropy(self, p: Float[Array, " outputs"]) -> Scalar:
        """Σ (s + ½ log 2πe), in nats."""
        return jnp.sum(_split(p)[1] + 0.5 + _HALF_LOG_2PI)

    def action(self, raw: Float[Array, " act"]) -> Float[Array, " act"]:
        """Clipped to the box, in its units."""
        return _to_box(self.box, jnp.clip(raw, -1.0, 1.0))


@struct.dataclass
class SquashedGaussian:
    """a ~ N(mean, exp(2 s)); the system takes tanh a, stretched to the box.

    `log_prob` is the density of tanh a, in half-widths of the box: log N(a) − Σ log(1 − tanh² a).

    Source: Haarnoja et al. 2018
    """

    box: Box

    @property
    def outputs(self) -> int:
        """Mean and log standard deviation of each axis."""
        return 2 * self.box.size

    @property
    def chances(self) -> int:
        """One number for each axis."""
        return self.box.size

    def noise(self, uniform: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Standard normal numbers."""
        return normal(uniform)

    def sample(self, p: Float[Array, " outputs"], noise: Float[Array, " act"]) -> Float[Array, " act"]:
        """Mean plus scaled noise, before tanh."""
        mean, log_std = _bounded(p)
        return mean + jnp.exp(log_std) * noise

    def mode(self, p: Float[Array, " outputs"]) -> Float[Array, " act"]:
        """The mean, before tanh."""
        return _split(p)[0]

    def log_prob(self, p: Float[Array, " outputs"], raw: Float[Array, " act"]) -> Scalar:
        """Log density of tanh a."""
        mean, log_std = _bounded(p)
        gaussian = -0.5 * ((raw - mean) * jnp.exp(-log_std)) ** 2 - log_std - _HALF_LOG_2PI
        size = jnp.abs(raw)
        return jnp.sum(gaussian - 2.0 * (_LOG_2 - size - jnp.log1p(jnp.exp(-2.0 * size))))

    def entropy(self, p: Float[Array, " outputs"]) -> Scalar:
        """Of the Gaussian before tanh, in nats; the squashed one has no closed form."""
        return jnp.sum(_bounded(p)[1] + 0.5 + _HALF_LOG_2PI)

    def action(self, raw: Float[Array, " act"]) -> Float[Array, " act"]:
        """Squashed and stretched to the box, in its units."""
        return _to_box(self.box, jnp.tanh(raw))


@struct.dataclass
class Explorer:
    """tanh p, in half-widths of the box; to explore, Gaussian noise is added, or a uniform action takes its place.

    Source: Plappert et al. 2018
    """

    box: Box
    deviation: Scalar
    """Standard deviation of the noise, in half-widths."""
    random: Scalar
    """Share of the actions that are uniform."""

    @property
    def outputs(self) -> int:
        """One for each axis."""
        return self.box.size

    @property
    def chances(self) -> int:
        """Two numbers for each axis, and one that says which of them counts."""
        return 2 * self.box.size + 1

    def noise(self, uniform: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """The uniform numbers themselves."""
        return uniform

    def sample(self, p: Float[Array, " act"], noise: Float[Array, " chances"]) -> Float[Array, " act"]:
        """An action to explore by, in half-widths of the box."""
        size = self.box.size
        noisy = jnp.clip(self.mode(p) + self.deviation * normal(noise[:size]), -1.0, 1.0)
        return jnp.where(noise[-1] < self.random, 2.0 * noise[size : 2 * size] - 1.0, noisy)

    def mode(self, p: Float[Array, " act"]) -> Float[Array, " act"]:
        """The hyperbolic tangent of p."""
        return jnp.tanh(p)

    def action(self, raw: Float[Array, " act"]) -> Float[Array, " act"]:
        """Stretched to the box, in its units."""
        return _to_box(self.box, raw)


def choose_head(actions: Box | Discrete) -> Categorical | Gaussian:
    """Indices are drawn from a categorical distribution, vectors from a Gaussian."""
    return Categorical(actions.count) if isinstance(actions, Discrete) else Gaussian(actions)


def _split(p: Any) -> tuple[Any, Any]:
    half = p.shape[-1] // 2
    return p[..., :half], p[..., half:]


def _bounded(p: Any) -> tuple[Any, Any]:
    mean, log_std = _split(p)
    return mean, jnp.clip(log_std, -10.0, 2.0)


def _to_box(box: Box, unit: Any) -> Any:
    return (box.low + box.high) / 2 + box.width / 2 * unit

"""Encoders: a recording becomes a fixed-length embedding, with no hand-made summaries.

Every encoder is a pair of pure functions over a batch of sequences. It reads the same features at each step: the
observations, their finite differences, the action, and whether the step happened.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from bayessim_jax.chance import draw
from bayessim_jax.contracts import Recording
from bayessim_jax.spelling import find_named

__all__ = [
    "ENCODERS",
    "Attention",
    "Encoder",
    "Features",
    "Lstm",
    "Windowed",
    "features_of",
    "lookup_encoder",
    "transition_features",
]

Features = Callable[[Recording], Float[Array, "steps features"]]
"""What an encoder reads of every transition of a recording; zero where it did not happen."""


class Encoder(Protocol):
    """Maps features of shape (batch, steps, features) and a mask of valid steps to (batch, size)."""

    def init(self, key: PRNGKeyArray, features: int) -> Any:
        """Random weights."""
        ...

    def apply(
        self, params: Any, x: Float[Array, "batch steps features"], valid: Bool[Array, "batch steps"]
    ) -> Float[Array, "batch size"]:
        """Embed every sequence."""
        ...


def transition_features(recording: Recording) -> Float[Array, "steps features"]:
    """What the encoder reads of transition t: yₜ, yₜ₊₁ − yₜ and uₜ; zero where the transition did not happen.

    The finite differences carry what θ changes; without them the network has to learn to subtract.
    """
    now, later = recording.observations[:-1], recording.observations[1:]
    x = jnp.concatenate([now, later - now, recording.actions], axis=-1)
    return jnp.where(recording.valid[:, None], x, 0.0)


def features_of(system: Any) -> Features:
    """The system's own `features`, where it knows what of a transition depends on θ, or `transition_features`."""
    return getattr(system, "features", transition_features)


def pool(
    x: Float[Array, "batch steps features"], valid: Bool[Array, "batch steps"], frame: int
) -> tuple[Float[Array, "batch frames features"], Bool[Array, "batch frames"]]:
    """Means over the valid ones of every `frame` successive steps; a frame is valid where at least one step is."""
    batch, steps, features = x.shape
    count = -(-steps // frame)
    pad = count * frame - steps
    on = jnp.pad(valid, ((0, 0), (0, pad))).reshape(batch, count, frame)
    x = jnp.pad(x, ((0, 0), (0, pad), (0, 0))).reshape(batch, count, frame, features)
    mean = jnp.where(on[..., None], x, 0.0).sum(2) / jnp.maximum(on.sum(2), 1)[..., None]
    return mean, on.any(-1)


def glorot(key: PRNGKeyArray, *shapes: tuple[int, int]) -> list[Float[Array, "rows columns"]]:
    """Uniform weights with variance 2/(rows + columns), for each of these (rows, columns)."""
    sizes = [math.prod(shape) for shape in shapes]
    parts = jnp.split(2.0 * draw(key, (sum(sizes),)) - 1.0, np.cumsum(sizes[:-1]))
    return [math.sqrt(6.0 / sum(shape)) * part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


@struct.dataclass
class Lstm:
    """The paper's encoder: a long short-term memory, here read out as the mean of its hidden states.

        s' = σ(f) s + σ(i) tanh(c),   h' = σ(o) tanh(s'),   (i, f, o, c) = W x + U h + b

    Every transition says something about θ, so the mean over them learns from far fewer recordings than the state after
    the last one does. Before the recurrence, layers that all steps share can read each transition (`widths`), and
    their outputs can be averaged over frames of steps (`frame`), which makes the recurrence as many times shorter.
    Invalid steps leave h and s as they are and do not count in a mean.

    Source: Hochreiter and Schmidhuber 1997
    """

    size: int = struct.field(pytree_node=False, default=64)
    widths: tuple[int, ...] = struct.field(pytree_node=False, default=())
    """Layers x ← gelu(W x + b) that read each step."""
    frame: int = struct.field(pytree_node=False, default=1)
    """Successive steps whose readings are averaged."""

    def init(self, key: PRNGKeyArray, features: int) -> dict[str, Any]:
        """Glorot weights, and a forget gate that starts open."""
        h, shapes = self.size, _shapes(features, self.widths)
        w, u, *read = glorot(key, ((features, *self.widths)[-1], 4 * h), (h, 4 * h), *shapes)
        return {
            "read": [_dense(weights) for weights in read],
            "w": w,
            "u": u,
            "b": jnp.zeros(4 * h).at[h : 2 * h].set(1.0),
        }

    def apply(
        self, params: Any, x: Float[Array, "batch steps features"], valid: Bool[Array, "batch steps"]
    ) -> Float[Array, "batch size"]:
        """The mean of the hidden states after valid steps."""
        h = self.size
        x = _read(params["read"], x)
        if self.frame > 1:
            x, valid = pool(x, valid, self.frame)
        # σ(a) = ½ + ½ tanh(a/2): with the halves folded into the weights all four gates are one tanh
        half = jnp.concatenate([jnp.full(3 * h, 0.5), jnp.ones(h)])
        weights = jnp.concatenate([params["u"], params["w"], params["b"][None]]) * half
        return _lstm(weights, jnp.swapaxes(x, 0, 1), jnp.swapaxes(valid, 0, 1))


def _gates(t: Float[Array, "batch gates"]) -> tuple[Array, Array, Array, Array]:
    i, f, o, c = jnp.split(t, 4, axis=-1)
    return 0.5 + 0.5 * i, 0.5 + 0.5 * f, 0.5 + 0.5 * o, c


@jax.custom_vjp
def _lstm(weights: Float[Array, "h+x+1 gates"], x: Float[Array, "steps batch x"], valid: Array) -> Array:
    """The rows of `weights` act on h, on x and on 1."""
    return _lstm_forward(weights, x, valid)[0]


def _lstm_forward(weights: Array, x: Array, valid: Array) -> tuple[Array, Any]:
    # The barriers keep XLA from computing each tanh once for every use of it, which doubled the time of a step.
    barrier = jax.lax.optimization_barrier
    share = valid / jnp.maximum(valid.sum(0), 1).astype(x.dtype)
    size = weights.shape[1] // 4
    u, w, b = weights[:size], weights[size:-1], weights[-1]
    inputs = (x.reshape(-1, x.shape[-1]) @ w + b).reshape(*valid.shape, -1)

    def step(carry: Any, now: Any) -> Any:
        h, s, mean = carry
        z, on, share = now
        t = barrier(jnp.tanh(z + h @ u))
        i, f, o, c = _gates(t)
        s_next = barrier(f * s + i * c)
        bounded = jnp.tanh(s_next)
        h_next, s_next = jnp.where(on[:, None], o * bounded, h), jnp.where(on[:, None], s_next, s)
        return (h_next, s_next, mean + share[:, None] * h_next), (h, s, t, bounded)

    zeros = jnp.zeros((inputs.shape[1], u.shape[0]), inputs.dtype)
    (_, _, mean), saved = jax.lax.scan(step, (zeros, zeros, zeros), (inputs, valid, share))
    return mean, (u, w, x, valid, share, saved)


def _lstm_backward(residuals: Any, dmean: Array) -> tuple[Array, Array, None]:
    u, w, x, valid, share, (hs, ss, ts, boundeds) = residuals
    barrier = jax.lax.optimization_barrier
    u_transposed = u.T

    def step(carry: Any, now: Any) -> Any:
        dh, ds = carry
        s, t, bounded, on, share = now
        on, dh = on[:, None], dh + share[:, None] * dmean
        i, f, o, c = _gates(t)
        dh_on, ds_on = jnp.where(on, dh, 0.0), jnp.where(on, ds, 0.0)
        ds_on = barrier(ds_on + dh_on * o * (1 - bounded * bounded))
        left = jnp.concatenate([ds_on * c * 0.5, ds_on * s * 0.5, dh_on * bounded * 0.5, ds_on * i], axis=-1)
        dz = barrier(left * (1 - t * t))
        return (dz @ u_transposed + jnp.where(on, 0.0, dh), ds_on * f + jnp.where(on, 0.0, ds)), dz

    zeros = jnp.zeros_like(dmean)
    _, dzs = jax.lax.scan(step, (zeros, zeros), (ss, ts, boundeds, valid, share), reverse=True)
    # one large product after the loop, not one small one in every step: those of few rows are slow on a CPU
    dzs = dzs.reshape(-1, dzs.shape[-1])
    given = jnp.concatenate([hs, x, jnp.ones((*valid.shape, 1), x.dtype)], axis=-1)
    return given.reshape(dzs.shape[0], -1).T @ dzs, (dzs @ w.T).reshape(x.shape), None


_lstm.defvjp(_lstm_forward, _lstm_backward)


@struct.dataclass
class Attention:
    """Means of what is read of each transition, with weights that are learned: nothing recurs.

        rₜ = layers(xₜ),   aₜₖ = exp sₖ(rₜ) / Σⱼ exp sₖ(rⱼ),   h = (Σₜ aₜₖ vₖ(rₜ), log Σₜ exp sₖ(rₜ))ₖ

    with scores s and values v linear in the readings r. Where what is observed is the whole state, each transition is
    an estimate of θ of its own, and most say little: vₖ takes the part of the estimate, exp sₖ that of its precision,
    and the last entry that of the precision of all together. Invalid steps have no weight.

    Source: Ilse et al. 2018; Lee et al. 2019
    """

    widths: tuple[int, ...] = struct.field(pytree_node=False, default=(64, 64))
    """Layers x ← gelu(W x + b) that read each step."""
    heads: int = struct.field(pytree_node=False, default=8)
    """Weightings of the steps, k."""
    values: int = struct.field(pytree_node=False, default=4)
    """Numbers that each weighting averages."""

    def init(self, key: PRNGKeyArray, features: int) -> dict[str, Any]:
        """Glorot weights; small ones for the scores, so that all steps count alike at first."""
        size, shapes = (features, *self.widths)[-1], _shapes(features, self.widths)
        score, value, *read = glorot(key, (size, self.heads), (size, self.heads * self.values), *shapes)
        return {"read": [_dense(weights) for weights in read], "score": _dense(0.1 * score), "value": _dense(value)}

    def apply(
        self, params: Any, x: Float[Array, "batch steps features"], valid: Bool[Array, "batch steps"]
    ) -> Float[Array, "batch size"]:
        """The weighted means, then the logarithms of the sums of weights."""
        x = _read(params["read"], x)
        scores = x @ params["score"]["w"] + params["score"]["b"]
        scores = jnp.where(valid[..., None], scores, -30.0)
        values = (x @ params["value"]["w"] + params["value"]["b"]).reshape(*scores.shape, self.values)
        means = jnp.einsum("bsh,bshv->bhv", jax.nn.softmax(scores, axis=1), values)
        return jnp.concatenate([means.reshape(x.shape[0], -1), jax.nn.logsumexp(scores, axis=1)], axis=-1)


def _dense(weights: Float[Array, "rows columns"]) -> dict[str, Array]:
    return {"w": weights, "b": jnp.zeros(weights.shape[1])}


def _shapes(features: int, widths: tuple[int, ...]) -> list[tuple[int, int]]:
    """Of the layers that read each step."""
    return list(zip((features, *widths), widths, strict=False))


def _read(layers: list[dict[str, Array]], x: Float[Array, "*n features"]) -> Float[Array, "*n size"]:
    """Layers that all steps share; the bias is the weight of a column of ones, so that its slope is no sum apart."""
    flat = x.reshape(-1, x.shape[-1])
    ones = jnp.ones((flat.shape[0], 1), x.dtype)
    for layer in layers:
        weights = jnp.concatenate([layer["w"], layer["b"][None]])
        flat = jax.nn.gelu(jnp.concatenate([flat, ones], axis=1) @ weights)
    return flat.reshape(*x.shape[:-1], flat.shape[-1])


@struct.dataclass
class Windowed:
    """A set of windows that share θ, laid end to end in one sequence: the mean of their embeddings, and of their rows.

    Every window is read by itself by the same encoder, so that their order is nothing and what one network learns of a
    window it knows of all. The means of the features stand beside: what is linear in them needs no learning.

    Source: Zaheer et al. 2017
    """

    each: Encoder = struct.field(pytree_node=False)
    windows: int = struct.field(pytree_node=False)

    def init(self, key: PRNGKeyArray, features: int) -> Any:
        """Those of the encoder of a window."""
        return self.each.init(key, features)

    def apply(
        self, params: Any, x: Float[Array, "batch steps features"], valid: Bool[Array, "batch steps"]
    ) -> Float[Array, "batch size"]:
        """Means over windows that hold a valid step, and over all valid steps."""
        split = lambda leaf: leaf.reshape(x.shape[0] * self.windows, -1, *leaf.shape[2:])  # noqa: E731
        there = split(valid).any(-1).reshape(x.shape[0], self.windows)
        embedded = self.each.apply(params, split(x), split(valid)).reshape(*there.shape, -1)
        return jnp.concatenate([_mean(embedded, there), _mean(x, valid)], axis=-1)


def _mean(x: Float[Array, "batch steps size"], valid: Bool[Array, "batch steps"]) -> Float[Array, "batch size"]:
    return jnp.where(valid[..., None], x, 0.0).sum(1) / jnp.maximum(valid.sum(1), 1)[:, None]


ENCODERS: dict[str, Encoder] = {
    "pooled_lstm": Lstm(size=32, widths=(32, 32), frame=10),
    "lstm": Lstm(),
    "attention": Attention(),
}


def lookup_encoder(name: str) -> Encoder:
    """Find an encoder by name, or raise `ValueError` with the near miss."""
    return find_named(name, ENCODERS, "unknown encoder")

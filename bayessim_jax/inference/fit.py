"""Fitting a conditional density: minibatches, early stopping on a validation split, and what to distrust."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from bayessim_jax.chance import draw
from bayessim_jax.contracts import Scalar

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["FitInfo", "Schedule", "fit", "systematic"]


@struct.dataclass
class Schedule:
    """How long and how to train. An epoch draws `draws` pairs in proportion to their weights, in batches."""

    learning_rate: float | Scalar = 4e-3
    epochs: int = struct.field(pytree_node=False, default=200)
    draws: int = struct.field(pytree_node=False, default=200)
    batch: int = struct.field(pytree_node=False, default=50)
    check_every: int = struct.field(pytree_node=False, default=5)
    """Epochs between looks at the validation pairs."""
    patience: int = struct.field(pytree_node=False, default=25)
    """Epochs without a better validation score after which training stops."""
    validation_draws: int = struct.field(pytree_node=False, default=100)
    """Held-out pairs looked at, drawn in proportion to their weights."""
    weight_decay: float = struct.field(pytree_node=False, default=1e-4)


@struct.dataclass
class FitInfo:
    """What a person wants to see of a fit; scores are mean log densities."""

    log_q_train: Scalar
    """Mean over the last epoch before the weights that were kept."""
    log_q_validation: Scalar
    """On held-out pairs, at the weights that were kept."""
    best_epoch: Int[Array, ""]
    epochs: Int[Array, ""]
    """Epochs run, at most the schedule's."""
    overfit: Bool[Array, ""]
    """The validation score fell well below its best while the training score rose."""
    nonfinite: Int[Array, ""]
    """Updates skipped because loss or gradient was not finite."""


def systematic(uniform: Float[Array, " 1+draws"], weights: Float[Array, " n"]) -> Int[Array, " draws"]:
    """Indices in proportion to weights with the least possible variance, in random order, from uniform numbers."""
    draws = uniform.size - 1
    cumulative = jnp.cumsum(weights)
    points = (jnp.arange(draws) + uniform[0]) / draws * cumulative[-1]
    picks = jnp.clip(jnp.searchsorted(cumulative, points), 0, weights.size - 1)
    return picks[jnp.argsort(uniform[1:])]


def fit(
    key: PRNGKeyArray,
    params: Any,
    log_prob: Callable[[Any, Any, Float[Array, "batch d"]], Float[Array, " batch"]],
    inputs: Any,
    z: Float[Array, "n d"],
    weights: Float[Array, " n"],
    held_out: Bool[Array, " n"],
    schedule: Schedule,
) -> tuple[Any, FitInfo]:
    """Maximize Σ wᵢ log q(zᵢ | inputsᵢ) by Adam with a cosine rate, and keep the weights best on held-out pairs.

    `inputs` is a pytree with leading axis n. A pair with weight zero is never drawn, a pair that is held out is never
    trained on; callers hold out the same rows in every round, so that warm weights have not seen them. A batch whose
    loss or gradient is not finite is skipped and counted. Training stops when nothing improved for `patience` epochs.
    """
    batches = max(schedule.draws // schedule.batch, 1)
    drawn, looked_at = batches * schedule.batch, min(schedule.validation_draws, z.shape[0])
    uniform = draw(key, (1 + schedule.epochs, 1 + max(drawn, looked_at)))
    train_weights = jnp.where(held_out, 0.0, weights)
    shown = systematic(uniform[-1, : 1 + looked_at], jnp.where(held_out, weights, 0.0))
    total = schedule.epochs * batches
    optimizer = optax.chain(optax.clip_by_global_norm(5.0), optax.scale_by_adam())
    # one vector of weights: with a leaf for each layer there is more to compile, and to start in every update
    start, unravel = ravel_pytree(params)

    def take(tree: Any, rows: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf[rows], tree)

    def score(flat: Array) -> Scalar:
        return log_prob(unravel(flat), take(inputs, shown), z[shown]).mean()

    def update(carry: Any, rows: Any) -> Any:
        flat, opt_state, count, skipped = carry
        loss, grads = jax.value_and_grad(lambda p: -log_prob(unravel(p), take(inputs, rows), z[rows]).mean())(flat)
        rate = schedule.learning_rate * 0.5 * (1 + jnp.cos(jnp.pi * count / total))
        sound = jnp.isfinite(loss) & jnp.isfinite(optax.tree.norm(grads))
        direction, new_opt_state = optimizer.update(grads, opt_state, flat)
        new_flat = flat - rate * (direction + schedule.weight_decay * flat)
        keep = lambda new, old: jax.tree.map(lambda a, b: jnp.where(sound, a, b), new, old)  # noqa: E731
        carry = (keep(new_flat, flat), keep(new_opt_state, opt_state), count + 1, skipped + ~sound)
        return carry, jnp.where(sound, -loss, 0.0)

    def epoch(carry: Any, index: Any) -> Any:
        rows = systematic(uniform[index, : 1 + drawn], train_weights)
        carry, scores = jax.lax.scan(update, carry, rows.reshape(batches, schedule.batch))
        return carry, scores.mean()

    def block(loop: Any) -> Any:
        carry, best, done, _ = loop
        carry, scores = jax.lax.scan(epoch, carry, done + jnp.arange(schedule.check_every))
        done = done + schedule.check_every
        last = score(carry[0])
        better = last > best["validation"]
        new = {"flat": carry[0], "validation": last, "train": scores[-1], "epoch": done}
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, best)
        return carry, best, done, {"validation": last, "train": scores[-1]}

    def more(loop: Any) -> Any:
        _, best, done, _ = loop
        return (done + schedule.check_every <= schedule.epochs) & (done - best["epoch"] < schedule.patience)

    low = jnp.array(-jnp.inf)
    best = {"flat": start, "validation": low, "train": low, "epoch": jnp.array(0)}
    carry = (start, optimizer.init(start), jnp.array(0), jnp.array(0))
    loop = (carry, best, jnp.array(0), {"validation": low, "train": low})
    carry, best, done, last = jax.lax.while_loop(more, block, loop)
    return unravel(best["flat"]), FitInfo(
        log_q_train=best["train"],
        log_q_validation=best["validation"],
        best_epoch=best["epoch"],
        epochs=done,
        overfit=(last["validation"] < best["validation"] - 1.0) & (last["train"] > best["train"]),
        nonfinite=carry[3],
    )

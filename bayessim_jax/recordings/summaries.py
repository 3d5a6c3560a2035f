"""What is written down of a round: draws of the posterior, and numbers that say how good it is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.contracts import Belief, Box, Scalar

if TYPE_CHECKING:
    from bayessim_jax.online import RoundInfo

__all__ = ["Summary", "metrics_line", "summarize"]


@struct.dataclass
class Summary:
    """A posterior in draws, and how it stands to the truth; what needs the truth is NaN where θ* is unknown."""

    draws: Float[Array, "n d"]
    mean: Float[Array, " d"]
    sd: Float[Array, " d"]
    log_prob_true: Scalar
    """log q(θ*) in raw units of θ."""
    level_true: Scalar
    """Smallest credible level of a highest-density set that holds θ*: uniform on [0, 1] over calibrated runs."""
    rank_true: Float[Array, " d"]
    """Share of the draws below θ*, a parameter at a time: uniform on [0, 1] over calibrated runs."""


def summarize(key: PRNGKeyArray, belief: Belief, truth: Float[Array, " d"], n: int = 1000) -> Summary:
    """Draw from a posterior and compare it with θ*; a NaN truth means that θ* is unknown.

    Source: Talts et al. 2018
    """
    draws = jax.vmap(belief.sample)(jax.random.split(key, n))
    known = jnp.isfinite(truth).all()
    log_probs = jax.vmap(belief.log_prob)(jnp.concatenate([draws, truth[None]]))
    log_prob_true = jnp.where(known, log_probs[-1], jnp.nan)
    denser = (log_probs[:-1] > log_prob_true).mean()
    return Summary(
        draws=draws,
        mean=draws.mean(0),
        sd=draws.std(0),
        log_prob_true=log_prob_true,
        level_true=jnp.where(known, denser, jnp.nan),
        rank_true=jnp.where(known, (draws < truth).mean(0), jnp.nan),
    )


def metrics_line(
    index: int,
    seed: int,
    parameters: Box,
    simulations: int,
    seconds: float,
    summary: Summary,
    info: RoundInfo,
    truth: Float[np.ndarray, " d"],
) -> dict[str, Any]:
    """The line of `metrics.jsonl` for one round (counted from 1) of one seed.

    `log_prob_true` is in raw units of θ; `log_prob_true_scaled` is the density of θ divided by the prior's width,
    log q(θ*) + Σ log(high − low), and `gain_over_prior` is log q(θ*) − log p(θ*): for a uniform prior they are equal.
    `truth` is θ* in that round. `simulations` counts the trajectories of all seeds that shared the `seconds` of a
    round that infers.
    """
    inferred = np.isfinite(info.pool_size)
    named = lambda values: dict(zip(parameters.names, np.asarray(values, float).tolist(), strict=True))  # noqa: E731
    width = float(np.log(np.asarray(parameters.width, float)).sum())
    log_prob_true = float(summary.log_prob_true)
    return {
        "round": index,
        "seed": seed,
        "log_prob_true": log_prob_true,
        "log_prob_true_scaled": log_prob_true + width,
        "gain_over_prior": log_prob_true + width,
        "return_target": float(info.return_target),
        "cost_target": float(info.cost_target),
        "success_target": float(info.success_target),
        "return_simulated": float(np.mean(info.learning.return_mean)),
        "seconds": seconds,
        "simulations_per_second": simulations / max(seconds, 1e-9) if inferred else 0.0,
        "diverged": int(info.diverged),
        "diverged_target": int(np.sum(info.recordings.diverged)),
        "masked": int(np.sum(info.learning.nonfinite)),
        "nonfinite": int(info.fit.nonfinite + info.calibration.nonfinite) + int(np.sum(info.learning.skipped)),
        "overfit": bool(info.fit.overfit),
        "overconfident": bool(info.calibration.overconfident),
        "uninformed": bool(info.uninformed),
        "collapsed": bool(info.collapsed),
        "strangeness": float(info.strangeness),
        "pool_size": float(info.pool_size),
        "log_q_train": float(info.fit.log_q_train),
        "log_q_validation": float(info.fit.log_q_validation),
        "best_epoch": int(info.fit.best_epoch),
        "prior_share": float(info.belief.prior_share),
        "coverage50": float(info.calibration.coverage50),
        "coverage90": float(info.calibration.coverage90),
        "coverage90_network": float(info.calibration.coverage90_network),
        "widen": float(info.calibration.widen),
        "level_true": float(summary.level_true),
        "rank_true": named(summary.rank_true),
        "truth": named(truth),
        "mean": named(summary.mean),
        "sd": named(summary.sd),
    }

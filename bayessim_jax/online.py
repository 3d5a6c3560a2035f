"""Online BayesSim: the outer loop, as pure functions.

Source: Possas et al. 2020, Algorithm 1
"""

from __future__ import annotations

from typing import Any

from flax import struct
from jaxtyping import Array, Int

from bayessim_jax.contracts import Recording, Scalar

__all__ = ["RoundInfo"]


@struct.dataclass
class RoundInfo:
    """What a person wants to see of one round."""

    belief: Any
    """The posterior after the round, a `beliefs.Truncated`."""
    recordings: Recording
    """What the target showed in this round, with a leading `set` axis."""
    fit: Any
    """The estimator's Info: `log_q_train`, `log_q_validation`, `best_epoch`, `coverage90`, `overfit`,
    `overconfident`, `nonfinite`."""
    learning: Any
    """The learner's Info: at least `return_mean` and `nonfinite`."""
    return_target: Scalar
    """Mean return of the evaluation episodes on the target (deterministic policy, the task's full length)."""
    diverged: Int[Array, ""]
    """Simulations of this round that were masked because a number was not finite."""

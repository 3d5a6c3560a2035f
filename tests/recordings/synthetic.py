"""Rounds made up from beliefs, with no loop behind them."""

import jax
import jax.numpy as jnp
from flax import struct

from bayessim_jax.beliefs.mixture import GaussianMixture
from bayessim_jax.beliefs.truncated import Truncated
from bayessim_jax.contracts import Recording
from bayessim_jax.online import RoundInfo


@struct.dataclass
class Fit:
    log_q_train: jax.Array
    log_q_validation: jax.Array
    best_epoch: jax.Array
    overfit: jax.Array
    nonfinite: jax.Array


@struct.dataclass
class Calibration:
    coverage50: jax.Array
    coverage90: jax.Array
    coverage90_network: jax.Array
    widen: jax.Array
    overconfident: jax.Array
    nonfinite: jax.Array


@struct.dataclass
class Learning:
    return_mean: jax.Array
    nonfinite: jax.Array
    skipped: jax.Array


@jax.jit
def belief_around(mean, sd, box):
    """A Gaussian cut to the box."""
    return Truncated.create(GaussianMixture(jnp.zeros(1), mean[None], jnp.diag(sd)[None]), box)


def one_info(system, index, truth, steps=5, recordings=2, **flags):
    """Round `index` (from 1) of one seed: a Gaussian around θ* whose width falls as 1/index."""
    box = system.parameters
    mean = jnp.asarray(truth) + 0.01 * box.width / index
    size = system.actions.size
    ramp = jnp.linspace(0.0, index, steps + 1)[:, None] * jnp.ones(system.observations.size)
    seen = Recording(
        times=system.dt * jnp.arange(steps + 1.0),
        observations=ramp,
        actions=jnp.full((steps, size), float(index)),
        rewards=jnp.ones(steps),
        valid=jnp.arange(steps) < steps - 1,
        diverged=jnp.array(False),
    )
    flag = lambda name: jnp.array(flags.get(name, False))  # noqa: E731
    return RoundInfo(
        belief=belief_around(mean, 0.2 * box.width / index, box),
        recordings=jax.tree.map(lambda x: jnp.stack([x] * recordings), seen),
        fit=Fit(
            log_q_train=jnp.array(1.0 * index),
            log_q_validation=jnp.array(flags.get("log_q_validation", 0.9 * index)),
            best_epoch=jnp.array(100),
            overfit=flag("overfit"),
            nonfinite=jnp.array(0),
        ),
        calibration=Calibration(
            coverage50=jnp.array(0.5),
            coverage90=jnp.array(0.9),
            coverage90_network=jnp.array(0.8),
            widen=jnp.array(1.1),
            overconfident=flag("overconfident"),
            nonfinite=jnp.array(0),
        ),
        learning=Learning(return_mean=jnp.array(10.0 * index), nonfinite=jnp.array(0), skipped=jnp.array(0)),
        return_target=jnp.array(20.0 * index),
        cost_target=jnp.array(0.1 * index),
        success_target=jnp.array(0.1 * index),
        diverged=jnp.array(0),
        pool_size=jnp.array(100.0),
        uninformed=flag("uninformed"),
        collapsed=flag("collapsed"),
        strangeness=jnp.array(flags.get("strangeness", 0.3)),
    )


def stacked(system, index, truths, **flags):
    """The same with a leading axis over seeds, one θ* for each."""
    infos = [one_info(system, index, truth, **flags) for truth in truths]
    return jax.tree.map(lambda *xs: jnp.stack(xs), *infos)


STATE = {"weights": jnp.arange(4.0), "round": jnp.array(0)}


def state_after(index):
    return {"weights": STATE["weights"] * index, "round": jnp.array(index)}


SETTINGS = {"system": "cartpole", "seed": 3, "rounds": 4, "prior": {"length": [0.1, 1.0]}}

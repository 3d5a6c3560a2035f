"""Online BayesSim: the outer loop, as pure functions.

Each round the policy acts on the target, the simulator is run under the same policy with θ from a proposal around the
belief, the estimator learns q(θ | recordings) from what was simulated, the belief is updated with what was recorded,
and the policy is improved against the new belief.

    state = init(key, setup)
    state, infos = jax.jit(run, static_argnames="rounds")(key, setup, target, state, rounds=30)

or, where the recordings come from a machine, `state, info = update(key, setup, state, recordings)` once a round. Keys
of a round come from `fold_in(key, state.round)`: a run that is cut, resumed or whole is the same run, bit for bit.

Source: Possas et al. 2020, Algorithm 1
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

from bayessim_jax.beliefs import Truncated
from bayessim_jax.contracts import Estimator, Learner, Recording, Scalar, System, Target, Task
from bayessim_jax.inference.estimators import recurrent_mixture
from bayessim_jax.inference.proposals import ProposalMode, lookup_proposal, pool_weights
from bayessim_jax.rollout import rollout

__all__ = ["Pool", "RoundInfo", "Setup", "State", "init", "record", "run", "simulate", "update"]


@struct.dataclass
class Setup:
    """What a run is made of. Numbers that fix shapes are static, everything else is traced."""

    system: System[Any]
    learner: Learner[Any]
    estimator: Estimator[Any]
    proposal: ProposalMode
    task: Task[Any] | None
    steps: int = struct.field(pytree_node=False, default=50)
    """Transitions in a recording, real or simulated."""
    simulations: int = struct.field(pytree_node=False, default=200)
    """Draws of θ that are simulated in a round; each gives as many trajectories as the target gives recordings."""
    recordings: int = struct.field(pytree_node=False, default=1)
    """Trajectories of the target in a round; together they are one piece of evidence."""
    evaluations: int = struct.field(pytree_node=False, default=1)
    """Episodes of the task's full length on which the deterministic policy is judged in a round; 0 for none."""
    pool: int = struct.field(pytree_node=False, default=10)
    """Rounds whose simulations are kept for the fit."""
    components: int = struct.field(pytree_node=False, default=5)
    """Gaussians in the belief."""

    @classmethod
    def create(
        cls,
        system: System[Any],
        learner: Learner[Any],
        task: Task[Any] | None = None,
        *,
        estimator: Estimator[Any] | None = None,
        proposal: str | ProposalMode = "corrected",
        **sizes: int,
    ) -> Setup:
        """The paper's settings, unless told otherwise; the prior is uniform on `system.parameters`."""
        for name, value in sizes.items():
            if value < (0 if name == "evaluations" else 1):
                raise ValueError(f"Setup: {name} is {value}; it must be a positive number.")
        return cls(
            system=system,
            learner=learner,
            task=task,
            estimator=recurrent_mixture() if estimator is None else estimator,
            proposal=lookup_proposal(proposal) if isinstance(proposal, str) else proposal,
            **sizes,
        )


@struct.dataclass
class Pool:
    """Simulations of the last rounds: axes are (round slot, draw of θ, recording of the set, …)."""

    thetas: Float[Array, "rounds n d"]
    recordings: Recording
    proposals: Any
    filled: Float[Array, " rounds"]


@struct.dataclass
class State:
    """What the next round needs."""

    round: Int[Array, ""]
    belief: Truncated
    estimator: Any
    learner: Any
    pool: Pool


@struct.dataclass
class RoundInfo:
    """What a person wants to see of one round."""

    belief: Truncated
    """The posterior after the round."""
    recordings: Recording
    """What the target showed in this round, with a leading `set` axis."""
    fit: Any
    """The estimator's Info: `log_q_train`, `log_q_validation`, `best_epoch`, `coverage90`, `overfit`,
    `overconfident`, `nonfinite`."""
    learning: Any
    """The learner's Info: at least `return_mean` and `nonfinite`."""
    return_target: Scalar
    """Mean return of the evaluation episodes on the target; NaN where none is run."""
    diverged: Int[Array, ""]
    """Simulations of this round that were masked because a number was not finite."""
    pool_size: Scalar
    """Effective number of simulations that the fit stood on, (Σ w)² / Σ w²."""
    collapsed: Any
    """The belief fell to less than a thousandth of its volume in one round while the fit was over-confident."""


def init(key: PRNGKeyArray, setup: Setup) -> State:
    """The prior as the belief, random weights, an empty pool."""
    learner_key, estimator_key = jax.random.split(key)
    belief = Truncated.uniform(setup.system.parameters, setup.components)
    learner = setup.learner.init(learner_key)
    proposal = setup.proposal.propose(belief)
    d = setup.system.parameters.size
    shape = jax.eval_shape(lambda: simulate(key, setup, learner, belief.box.low[None].repeat(setup.simulations, 0)))
    example = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape[1:], leaf.dtype), shape)
    slots = setup.pool if setup.proposal.reuse else 1
    return State(
        round=jnp.array(0),
        belief=belief,
        estimator=setup.estimator.init(estimator_key, example, d),
        learner=learner,
        pool=Pool(
            thetas=jnp.broadcast_to(belief.box.low, (slots, setup.simulations, d)),
            recordings=jax.tree.map(lambda leaf: jnp.zeros((slots, *leaf.shape), leaf.dtype), shape),
            proposals=jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (slots, *jnp.shape(leaf))), proposal),
            filled=jnp.zeros(slots),
        ),
    )


def simulate(key: PRNGKeyArray, setup: Setup, learner: Any, thetas: Float[Array, "n d"]) -> Recording:
    """A set of recordings for each θ, under the current stochastic policy; leading axes (n, set)."""
    policy = setup.learner.policy(learner)

    def one(key: PRNGKeyArray, theta: Float[Array, " d"]) -> Recording:
        return rollout(key, setup.system, theta, policy, setup.steps, setup.task)

    keys = jax.random.split(key, (thetas.shape[0], setup.recordings))
    return jax.vmap(jax.vmap(one, (0, None)))(keys, thetas)


def record(key: PRNGKeyArray, setup: Setup, target: Target, state: State) -> Recording:
    """One round's recordings of the target under the current stochastic policy; leading axis `set`."""
    policy = setup.learner.policy(state.learner)
    keys = jax.random.split(jax.random.fold_in(key, state.round), setup.recordings)
    return jax.vmap(lambda k: target.record(k, policy, setup.steps))(keys)


def evaluate(key: PRNGKeyArray, setup: Setup, target: Target, state: State) -> Scalar:
    """Mean return of the deterministic policy over `setup.evaluations` full episodes on the target."""
    if setup.task is None or setup.evaluations == 0:
        return jnp.array(jnp.nan)
    policy, steps = setup.learner.policy(state.learner, deterministic=True), setup.task.steps
    keys = jax.random.split(jax.random.fold_in(key, state.round), setup.evaluations)
    return jax.vmap(lambda k: target.record(k, policy, steps).rewards.sum())(keys).mean()


def update(key: PRNGKeyArray, setup: Setup, state: State, recordings: Recording) -> tuple[State, RoundInfo]:
    """One round on recordings made with the current policy (leading axis `set`, `setup.recordings` long)."""
    if recordings.valid.shape != (setup.recordings, setup.steps):
        raise ValueError(
            f"update: recordings have shape {recordings.valid.shape} (set, steps); this setup was made for "
            f"({setup.recordings}, {setup.steps}): pad the recordings or change `recordings` and `steps`."
        )
    draw_key, simulate_key, fit_key, learn_key = jax.random.split(jax.random.fold_in(key, state.round), 4)
    proposal = setup.proposal.propose(state.belief)
    thetas = jax.vmap(proposal.sample)(jax.random.split(draw_key, setup.simulations))
    simulated = simulate(simulate_key, setup, state.learner, thetas)
    pool = _insert(state.pool, state.round, thetas, simulated, proposal)
    weights = pool_weights(pool.thetas, pool.proposals, pool.filled, proposal).ravel()

    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (pool.thetas, pool.recordings))
    estimator, fit = setup.estimator.fit(fit_key, state.estimator, *flat, weights)
    q = setup.estimator.posterior(estimator, recordings)
    posterior = setup.proposal.combine(state.belief, proposal, q)
    unusable = recordings.diverged.any()
    belief = jax.tree.map(lambda old, new: jnp.where(unusable, old, new), state.belief, posterior)
    learner, learning = setup.learner.step(learn_key, state.learner, belief)

    shrinkage = jnp.linalg.slogdet(belief.covariance())[1] - jnp.linalg.slogdet(state.belief.covariance())[1]
    info = RoundInfo(
        belief=belief,
        recordings=recordings,
        fit=fit,
        learning=learning,
        return_target=jnp.array(jnp.nan),
        diverged=simulated.diverged.sum(),
        pool_size=weights.sum() ** 2 / (weights**2).sum(),
        collapsed=(0.5 * shrinkage < -jnp.log(1e3)) & fit.overconfident,
    )
    return State(state.round + 1, belief, estimator, learner, pool), info


def run(
    key: PRNGKeyArray, setup: Setup, target: Target, state: State | None = None, *, rounds: int = 30
) -> tuple[State, RoundInfo]:
    """`rounds` rounds as one scan; the Info of every round is stacked. Continue by passing the state returned."""
    init_key, target_key, update_key, evaluate_key = jax.random.split(key, 4)

    def one_round(state: State, _: None) -> tuple[State, RoundInfo]:
        recordings = record(target_key, setup, target, state)
        state, info = update(update_key, setup, state, recordings)
        return state, info.replace(return_target=evaluate(evaluate_key, setup, target, state))

    return jax.lax.scan(one_round, init(init_key, setup) if state is None else state, None, length=rounds)


def _insert(pool: Pool, round_: Array, thetas: Array, recordings: Recording, proposal: Any) -> Pool:
    """Overwrite the oldest slot."""
    slot = round_ % pool.filled.shape[0]
    return jax.tree.map(
        lambda leaf, new: leaf.at[slot].set(new), pool, Pool(thetas, recordings, proposal, jnp.ones(()))
    )

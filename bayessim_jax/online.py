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

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from bayessim_jax.beliefs import Truncated
from bayessim_jax.contracts import Estimator, GoalTask, Learner, Policy, Recording, Scalar, System, Target, Task
from bayessim_jax.inference.encoders import features_of
from bayessim_jax.inference.estimators import recurrent_mixture
from bayessim_jax.inference.proposals import ProposalMode, lookup_proposal, pool_weights
from bayessim_jax.inference.strangeness import strangeness
from bayessim_jax.learning.fixed import RecordedActions
from bayessim_jax.rollout import rollout

__all__ = [
    "COMPILER_OPTIONS",
    "FOREVER",
    "Keys",
    "Pool",
    "RoundInfo",
    "Setup",
    "State",
    "evaluate",
    "improve",
    "infers",
    "init",
    "record",
    "run",
    "simulate",
    "split",
    "update",
]


COMPILER_OPTIONS = {"xla_backend_optimization_level": 1}
"""For `jax.jit(run, …, compiler_options=…)`: a whole run compiles faster and takes as long."""


FOREVER = 2**30
"""More rounds than any run has."""
SETS, FEWEST, MOST = 32_768, 1024, 4096
"""Recordings that are simulated in a round as sets, where nothing else is asked for, and how few and many sets."""
STANDING = 2 / 3
"""Share of the belief where a wider posterior contradicts it: more often than not it is the better one of the two."""


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
    """Trajectories that are simulated in a round to fit the estimator, each with its own θ."""
    recordings: int = struct.field(pytree_node=False, default=1)
    """Trajectories of the target in a round."""
    evaluations: int = struct.field(pytree_node=False, default=1)
    """Episodes of the task's full length on which the deterministic policy is judged in a round; 0 for none."""
    pool: int = struct.field(pytree_node=False, default=10)
    """Rounds whose simulations are kept for the fit."""
    history: int = struct.field(pytree_node=False, default=32)
    """Recordings of the target that are remembered, the newest; the posterior is conditioned on all of them."""
    calibrations: int = struct.field(pytree_node=False, default=FEWEST)
    """Draws of θ for which as many recordings are simulated as the target has given: what the posterior of several
    recordings is learned from, and calibrated."""
    kept: int = struct.field(pytree_node=False, default=0)
    """Of these sets, how many at most join the pool: their recordings are fitted from the next round on."""
    components: int = struct.field(pytree_node=False, default=5)
    """Gaussians in the belief."""
    replay: bool = struct.field(pytree_node=False, default=False)
    """Simulate under the recorded actions in place of the policy that chose them. The policy's share in the likelihood
    of a recording does not depend on θ, so the posterior is the same; planners are too dear to be simulated with."""

    forget: float = struct.field(pytree_node=False, default=0.0)
    """Probability that θ of the target changed between two rounds. Above 0, simulations are made for what the prior
    allows too, and recordings that contradict the newest one no longer count."""
    warmup: int = struct.field(pytree_node=False, default=0)
    """Rounds before the first recording, in which only the policy improves, against the prior."""
    inferences: int = struct.field(pytree_node=False, default=FOREVER)
    """Rounds, after these, that record and infer: all of them for the paper's loop, one for a posterior found once
    with the policy of that moment and then kept, none for domain randomization over the prior."""

    @classmethod
    def create(
        cls,
        system: System[Any],
        learner: Learner[Any],
        task: Task[Any] | None = None,
        *,
        estimator: Estimator[Any] | None = None,
        proposal: str | ProposalMode = "truncated",
        replay: bool = False,
        forget: float = 0.0,
        **sizes: int,
    ) -> Setup:
        """The paper's settings, unless told otherwise; the prior is uniform on `system.parameters`.

        `calibrations` of 0 are as many sets as make 32,768 recordings, but 1024 at least and 4096 at most: where few
        recordings are remembered, more of their sets are to be had at the same cost.

        Raises `ValueError` where a number is none that a run can have.
        """
        for name, value in sizes.items():
            if value < (0 if name in ("evaluations", "warmup", "inferences", "calibrations", "kept") else 1):
                raise ValueError(f"Setup: {name} is {value}; it must be a positive number.")
        history, recordings = sizes.get("history", cls.history), sizes.get("recordings", cls.recordings)
        if not sizes.get("calibrations"):
            sizes["calibrations"] = min(max(SETS // history, FEWEST), MOST)
        sizes["kept"] = min(sizes.get("kept", 0), sizes["calibrations"])
        if not 0 <= forget < 1:
            raise ValueError(f"Setup: forget is {forget}; it is a probability, from 0 to below 1.")
        if history % recordings:
            raise ValueError(
                f"Setup: history is {history}, no multiple of recordings, {recordings}, so a round's would not be "
                f"forgotten together; take a history of {max(history // recordings, 1) * recordings}."
            )
        return cls(
            system=system,
            learner=learner,
            task=task,
            estimator=recurrent_mixture(features=features_of(system)) if estimator is None else estimator,
            proposal=lookup_proposal(proposal) if isinstance(proposal, str) else proposal,
            replay=replay,
            forget=forget,
            **sizes,
        )

    @property
    def remembered(self) -> int:
        """How many recordings the posterior is conditioned on: `history`, or a round's in the paper's mode."""
        return self.history if self.proposal.accumulate else self.recordings


@struct.dataclass
class Pool:
    """Simulations of the last rounds: axes are (round slot, draw of θ, recording, …)."""

    thetas: Float[Array, "rounds n d"]
    recordings: Recording
    proposals: Any
    filled: Bool[Array, "rounds recording"]
    """Which recordings of every draw are there to be fitted."""


@struct.dataclass
class State:
    """What the next round needs."""

    round: Int[Array, ""]
    belief: Truncated
    estimator: Any
    learner: Any
    pool: Pool
    """One recording of every draw."""
    sets: Pool
    """`setup.kept` draws with as many recordings as are remembered, simulated for the calibration."""
    history: Recording
    """What the target has shown, leading axis `setup.history`; the slots not yet filled are empty recordings."""
    policies: Any
    """The policy under which each recording of `history` was made, or its actions where they are replayed."""


@struct.dataclass
class RoundInfo:
    """What a person wants to see of one round."""

    belief: Truncated
    """The posterior after the round."""
    recordings: Recording
    """What the target showed in this round, with a leading `set` axis."""
    fit: Any
    """The estimator's Info of the fit: `log_q_train`, `log_q_validation`, `best_epoch`, `overfit`, `nonfinite`."""
    calibration: Any
    """The estimator's Info of the calibration: `coverage50`, `coverage90`, `widen`, `overconfident`, …."""
    learning: Any
    """The learner's Info: at least `return_mean`, `nonfinite` and `skipped`."""
    return_target: Scalar
    """Mean return of the evaluation episodes on the target; NaN where none is run."""
    cost_target: Scalar
    """Minus the mean reward of a step in them."""
    success_target: Scalar
    """Share of them that were at their goal in the end; NaN where the task has no goal."""
    diverged: Int[Array, ""]
    """Simulations of this round, to fit and to calibrate, that were masked because a number was not finite."""
    pool_size: Scalar
    """Effective number of simulations that the fit stood on, (Σ w)² / Σ w²."""
    uninformed: Bool[Array, ""]
    """The posterior of this round was wider than the belief and agreed with it, so the belief stayed."""
    collapsed: Bool[Array, ""]
    """The belief is a posterior whose networks collapsed: `calibration.collapsed`."""
    strangeness: Scalar
    """By how many standard deviations what the target showed lies farther out than what is simulated around the belief
    (`inference.strangeness`); NaN where nothing was recorded."""


class Keys(NamedTuple):
    """The keys that a run passes to `init`, `record`, `update` and `evaluate`, the same ones in every round."""

    init: PRNGKeyArray
    record: PRNGKeyArray
    update: PRNGKeyArray
    evaluate: PRNGKeyArray


def split(key: PRNGKeyArray) -> Keys:
    """What `run` makes of its key: with these, a loop over `record`, `update` and `evaluate` is the same run."""
    return Keys(*jax.random.split(key, 4))


def init(key: PRNGKeyArray, setup: Setup) -> State:
    """The prior as the belief, random weights, an empty pool."""
    learner_key, estimator_key = jax.random.split(key)
    belief = Truncated.uniform(setup.system.parameters, setup.components)
    learner = setup.learner.init(learner_key)
    proposal = setup.proposal.propose(belief.loosen(setup.forget) if setup.forget else belief)
    d = setup.system.parameters.size
    idle = RecordedActions(jnp.zeros((setup.steps, setup.system.actions.size)))
    policy = idle if setup.replay else setup.learner.policy(learner)
    one = jax.eval_shape(lambda: simulate(key, setup, policy, belief.box.low[None]))
    remembered = setup.remembered
    slots = setup.pool if setup.proposal.reuse else 1

    def empty(*axes: int) -> Recording:
        return jax.tree.map(lambda leaf: jnp.zeros((*axes, *leaf.shape[1:]), leaf.dtype), one)

    def blank(draws: int, size: int) -> Pool:
        return Pool(
            thetas=jnp.broadcast_to(belief.box.low, (slots, draws, d)),
            recordings=empty(slots, draws, size),
            proposals=jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (slots, *jnp.shape(leaf))), proposal),
            filled=jnp.zeros((slots, size), bool),
        )

    return State(
        round=jnp.array(0),
        belief=belief,
        estimator=setup.estimator.init(estimator_key, empty(remembered), d),
        learner=learner,
        pool=blank(setup.simulations, 1),
        sets=blank(setup.kept if setup.proposal.reuse else 0, remembered),
        history=empty(remembered),
        policies=jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (remembered, *jnp.shape(leaf))), policy),
    )


def simulate(
    key: PRNGKeyArray, setup: Setup, policy: Any, thetas: Float[Array, "n d"], slots: Int[Array, " n"] | None = None
) -> Recording:
    """One recording for every θ under one policy; with `slots`, under that slot of stacked ones; leading axis n."""
    keys = jax.random.split(key, thetas.shape[0])
    policies = policy if slots is None else jax.tree.map(lambda leaf: leaf[slots], policy)

    def one(key: PRNGKeyArray, policy: Policy, theta: Float[Array, " d"]) -> Recording:
        return rollout(key, setup.system, theta, policy, setup.steps, setup.task)

    return jax.vmap(one, in_axes=(0, None if slots is None else 0, 0))(keys, policies, thetas)


def record(key: PRNGKeyArray, setup: Setup, target: Target, state: State) -> Recording:
    """One round's recordings of the target under the current stochastic policy; leading axis `set`."""
    policy = setup.learner.policy(state.learner)
    keys = jax.random.split(jax.random.fold_in(key, state.round), setup.recordings)
    return jax.vmap(lambda k: target.record(k, policy, setup.steps))(keys)


def evaluate(key: PRNGKeyArray, setup: Setup, target: Target, state: State) -> dict[str, Scalar]:
    """How the deterministic policy fares in `setup.evaluations` full episodes on the target.

    Returns these fields of `RoundInfo`: mean return, mean cost of a step, and the share that was at its goal in the
    end, over the episodes that did not diverge. NaN where there is no task, no such episode, or no goal.
    """
    nothing = jnp.array(jnp.nan)
    if setup.task is None or setup.evaluations == 0:
        return {"return_target": nothing, "cost_target": nothing, "success_target": nothing}
    policy, task = setup.learner.policy(state.learner, deterministic=True), setup.task
    keys = jax.random.split(jax.random.fold_in(key, state.round), setup.evaluations)
    seen = jax.vmap(lambda k: target.record(k, policy, task.steps))(keys)
    mean = partial(jnp.mean, where=~seen.diverged)
    returns = seen.rewards.sum(-1)
    return {
        "return_target": mean(returns),
        "cost_target": -mean(returns / jnp.maximum(seen.valid.sum(-1), 1)),
        "success_target": mean(seen.rewards[:, -1] >= 0.0) if isinstance(task, GoalTask) else nothing,
    }


def infers(setup: Setup, round: Any) -> Any:
    """Whether round number `round`, counted from 0, records and infers; in all others only the policy improves."""
    return (round >= setup.warmup) & (round - setup.warmup < setup.inferences)


def update(key: PRNGKeyArray, setup: Setup, state: State, recordings: Recording) -> tuple[State, RoundInfo]:
    """One round on recordings made with the current policy (leading axis `set`, `setup.recordings` long).

    Raises `ValueError` where their shapes are not those that the setup was made for.
    """
    _check_shapes(setup, state, recordings)
    # barriers: what the compiler makes of a round does not depend on what stands around it, so that a round in a scan
    # and one called by itself are the same to the last bit
    state, recordings = jax.lax.optimization_barrier((state, recordings))
    draw_key, slot_key, simulate_key, sets_key, fit_key, calibrate_key, learn_key = _keys(key, state)
    policy = RecordedActions(recordings.actions) if setup.replay else setup.learner.policy(state.learner)
    done = state.round - setup.warmup
    history, policies, use, newest = _remember(state, done, recordings, policy)

    # simulate around the belief, every other draw under an earlier policy whose recordings still count
    known = state.belief.loosen(setup.forget) if setup.forget else state.belief
    proposal = setup.proposal.propose(known)
    fresh = setup.simulations
    thetas = jax.vmap(proposal.sample)(jax.random.split(draw_key, fresh + setup.calibrations))
    earlier = jax.random.categorical(slot_key, jnp.where(use, 0.0, -jnp.inf), shape=(fresh,))
    slots = jnp.where(jnp.arange(fresh) % 2 == 0, newest, jnp.where(use.any(), earlier, newest))
    simulated = simulate(simulate_key, setup, policies, thetas[:fresh], slots)
    singles = jax.tree.map(lambda x: x[:, None], simulated)
    pool = _insert(state.pool, done, thetas[:fresh], singles, proposal, jnp.ones(1, bool))
    pairs: Any = _pairs(pool, proposal)
    if state.sets.thetas.size:
        others = _pairs(state.sets, proposal, before=pairs[0].shape[0])
        pairs = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), pairs, others)
    weights = pairs[2]
    estimator, fit = setup.estimator.fit(fit_key, state.estimator, *pairs)

    if setup.forget:
        use = use & _agree(setup, estimator, history, newest)

    # the posterior of everything the target has shown, calibrated on sets made under the same policies
    set_keys = jax.random.split(sets_key, use.size)
    sets = jax.vmap(lambda k, p: simulate(k, setup, p, thetas[fresh:]), out_axes=1)(set_keys, policies)
    estimator, calibration, q = setup.estimator.calibrate(
        calibrate_key,
        estimator,
        thetas[fresh:],
        sets,
        history,
        use,
        state.belief.box,
        correct=setup.proposal.accumulate,
    )
    first, served = jax.tree.map(lambda leaf: leaf[: state.sets.thetas.shape[1]], (thetas[fresh:], sets))
    kept = _insert(state.sets, done, first, served, proposal, use)
    posterior = setup.proposal.combine(state.belief, proposal, q)
    growth, gap = posterior.against(state.belief)
    # a fit that says less than was known leaves the belief; where it contradicts it, one of the two is wrong
    agrees = gap < 2.0 * thetas.shape[1]
    uninformed = setup.proposal.accumulate & (growth > jnp.log(1.2)) & agrees
    if setup.proposal.accumulate and not setup.forget:
        torn, mixed = (growth > 0.0) & ~agrees, posterior.mix(state.belief, STANDING)
        posterior = jax.tree.map(lambda new, both: jnp.where(torn, both, new), posterior, mixed)
    stays = recordings.diverged.all() | uninformed
    belief = jax.tree.map(lambda old, new: jnp.where(stays, old, new), state.belief, posterior)
    learner, learning = setup.learner.step(learn_key, state.learner, belief)

    info = RoundInfo(
        belief=belief,
        recordings=recordings,
        fit=fit,
        calibration=calibration,
        learning=learning,
        return_target=jnp.array(jnp.nan),
        cost_target=jnp.array(jnp.nan),
        success_target=jnp.array(jnp.nan),
        diverged=simulated.diverged.sum() + (sets.diverged & use).sum(),
        pool_size=weights.sum() ** 2 / (weights**2).sum(),
        uninformed=uninformed,
        collapsed=calibration.collapsed & ~stays,
        strangeness=strangeness(sets, history, use),
    )
    after = State(state.round + 1, belief, estimator, learner, pool, kept, history, policies)
    return jax.lax.optimization_barrier((after, info))


def _check_shapes(setup: Setup, state: State, recordings: Recording) -> None:
    if recordings.valid.shape != (setup.recordings, setup.steps):
        raise ValueError(
            f"update: recordings have shape {recordings.valid.shape} (set, steps); this setup was made for "
            f"({setup.recordings}, {setup.steps}): pad the recordings or change `recordings` and `steps`."
        )
    for (path, given), known in zip(jax.tree.leaves_with_path(recordings), jax.tree.leaves(state.history), strict=True):
        if given.shape[1:] != known.shape[1:]:
            raise ValueError(
                f"update: {jax.tree_util.keystr(path, simple=True)} of the recordings have shape {given.shape}; this "
                f"setup's system asks for {(setup.recordings, *known.shape[1:])}."
            )


def improve(key: PRNGKeyArray, setup: Setup, state: State) -> tuple[State, RoundInfo]:
    """One round in which nothing is recorded and only the policy improves, against the belief as it is.

    What its Info says of recordings, fit and calibration is zero, and NaN where that could be taken for a result.
    """
    state = jax.lax.optimization_barrier(state)
    *_, learn_key = _keys(key, state)
    learner, learning = setup.learner.step(learn_key, state.learner, state.belief)
    one = jax.tree.map(lambda leaf: leaf[: setup.recordings], state.history)
    shape = jax.eval_shape(lambda s, r: update(key, setup, s, r)[1], state, one)

    def nothing(leaf: Any) -> Array:
        return jnp.full(leaf.shape, jnp.nan if jnp.issubdtype(leaf.dtype, jnp.floating) else 0, leaf.dtype)

    info = replace(
        jax.tree.map(nothing, shape),
        belief=state.belief,
        recordings=jax.tree.map(jnp.zeros_like, one),
        learning=learning,
    )
    return jax.lax.optimization_barrier((replace(state, round=state.round + 1, learner=learner), info))


def run(
    key: PRNGKeyArray, setup: Setup, target: Target, state: State | None = None, *, rounds: int = 30
) -> tuple[State, RoundInfo]:
    """`rounds` rounds as one scan; the Info of every round is stacked. Continue by passing the state returned."""
    keys = split(key)

    def infer(state: State) -> tuple[State, RoundInfo]:
        return update(keys.update, setup, state, record(keys.record, setup, target, state))

    def one_round(state: State, _: None) -> tuple[State, RoundInfo]:
        if setup.warmup == 0 and setup.inferences == FOREVER:
            state, info = infer(state)
        else:
            only = lambda state: improve(keys.update, setup, state)  # noqa: E731
            state, info = jax.lax.cond(infers(setup, state.round), infer, only, state)
        return state, replace(info, **evaluate(keys.evaluate, setup, target, state))

    return jax.lax.scan(one_round, init(keys.init, setup) if state is None else state, None, length=rounds)


def _keys(key: PRNGKeyArray, state: State) -> PRNGKeyArray:
    """Of everything in a round that is random."""
    return jax.random.split(jax.random.fold_in(key, state.round), 7)


def _insert(pool: Pool, done: Array, thetas: Array, recordings: Recording, proposal: Any, there: Array) -> Pool:
    """Overwrite the oldest slot."""
    slot = done % pool.filled.shape[0]
    return jax.tree.map(lambda leaf, new: leaf.at[slot].set(new), pool, Pool(thetas, recordings, proposal, there))


def _pairs(pool: Pool, proposal: Any, before: int = 0) -> tuple[Array, Recording, Array, Array]:
    """Every θ with each of its recordings alone: θ, recordings, weights, and the number of the draw, from `before` on.

    Also where an axis of recordings is empty (a machine without actuators).
    """
    slots, n, d = pool.thetas.shape
    size = pool.filled.shape[1]
    pairs = slots * n * size
    weights = pool_weights(pool.thetas, pool.proposals, pool.filled.any(-1), proposal)
    return (
        jnp.repeat(pool.thetas.reshape(slots * n, d), size, axis=0),
        jax.tree.map(lambda leaf: leaf.reshape(pairs, 1, *leaf.shape[3:]), pool.recordings),
        (weights[:, :, None] * pool.filled[:, None]).ravel(),
        before + jnp.repeat(jnp.arange(slots * n), size),
    )


def _remember(state: State, done: Array, recordings: Recording, policy: Policy) -> tuple[Recording, Any, Array, Array]:
    """Overwrite the oldest recordings and their policies; which slots hold a sound one; the slot of the newest."""
    size, new = state.history.diverged.size, recordings.diverged.size
    rows = (done * new + jnp.arange(new)) % size
    history = jax.tree.map(lambda leaf, part: leaf.at[rows].set(part), state.history, recordings)
    policies = jax.tree.map(lambda leaf, part: leaf.at[rows].set(part), state.policies, policy)
    use = (jnp.arange(size) < (done + 1) * new) & ~history.diverged
    return history, policies, use, rows[-1]


def _agree(setup: Setup, estimator: Any, history: Recording, newest: Array) -> Bool[Array, " set"]:
    """Which recordings could be of the same θ as the newest: the means of their own posteriors are not too far apart.

    The squared distance over the sum of both covariances is then χ² with d degrees of freedom; it is too large in one
    of a thousand.
    """
    alone = lambda one: setup.estimator.posterior(  # noqa: E731
        estimator, jax.tree.map(lambda leaf: leaf[None], one), jnp.ones(1, bool)
    )
    each = jax.vmap(alone)(history)
    means, covariances = jax.vmap(lambda q: (q.mean(), q.covariance()))(each)
    gaps, widths = means - means[newest], covariances + covariances[newest]
    distance = jax.vmap(lambda gap, width: gap @ jnp.linalg.solve(width, gap))(gaps, widths)
    return jax.scipy.stats.chi2.sf(distance, means.shape[-1]) > 1e-3

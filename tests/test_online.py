"""The outer loop: the same run however it is cut, and nothing silent."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from bayessim_jax import online
from bayessim_jax.beliefs import GaussianMixture, Truncated
from bayessim_jax.contracts import Box
from bayessim_jax.control import default_planner
from bayessim_jax.engines.simulated import SimulatedTarget
from bayessim_jax.inference import Lstm, MixtureHead, Schedule, recurrent_mixture
from bayessim_jax.inference.estimators import MixtureDensity
from bayessim_jax.inference.proposals import TruncatedPrior
from bayessim_jax.learning import Fixed, Ppo, RandomPolicy, RecordedActions, default_learner
from bayessim_jax.rollout import rollout
from bayessim_jax.systems import Balance, CartPole, Pendulum, SkidSteer, Upswing, from_functions
from bayessim_jax.systems.mjcf import Unknown, mjcf_system

TINY = MixtureDensity(Lstm(8, frame=4), MixtureHead(2, 8), Schedule(epochs=10, draws=32, batch=16), members=1, folds=4)

SWINGING = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/></body></worldbody></mujoco>"""

OPTIONS = online.COMPILER_OPTIONS | {"xla_cpu_use_fusion_emitters": True}
"""What is equal bit for bit is compiled with the emitters that users have, which the quick tests' flags leave out."""


@struct.dataclass
class Survive:
    """Paid 1 a step, which never ends it."""

    steps: int = struct.field(pytree_node=False)

    def reward(self, state, action, next_state):
        return jnp.ones(())

    def terminated(self, state):
        return jnp.array(False)


def compiled(function, **static):
    return jax.jit(function, compiler_options=OPTIONS, **static)


@pytest.fixture(scope="module")
def cartpole():
    system, task = CartPole.create(), Balance(steps=30)
    learner = Ppo.create(system, task, episodes=8, episode_steps=16)
    setup = online.Setup.create(
        system,
        learner,
        task,
        estimator=TINY,
        steps=16,
        simulations=32,
        evaluations=2,
        pool=2,
        components=2,
        history=4,
        calibrations=16,
        kept=5,
    )
    return setup, SimulatedTarget(system, task, jnp.array([0.4, 0.6]))


@pytest.fixture(scope="module")
def small():
    """x' = 0.9 x + 0.1 θ u, and NaN where θ is above 0.7; nothing is learned but the posterior: soon compiled."""
    system = from_functions(
        parameters=Box.create(rate=(0.1, 1.0, "1/s")),
        observations=Box.create(x=(-1.0, 1.0, "m")),
        actions=Box.create(u=(-1.0, 1.0, "N")),
        noise=0.01,
        dt=0.1,
        reset=lambda key, theta: jax.random.uniform(key, (1,)),
        step=lambda theta, x, u: jnp.where(theta[0] > 0.7, jnp.nan, 0.9 * x + 0.1 * theta * u),
    )
    sizes = {"steps": 12, "simulations": 64, "pool": 2, "components": 2, "history": 4, "calibrations": 16, "kept": 5}
    setup = online.Setup.create(system, Fixed(RandomPolicy(system.actions)), estimator=TINY, **sizes)
    return setup, SimulatedTarget(system, None, jnp.array([0.3]))


start, record, update = map(compiled, (online.init, online.record, online.update))
run = compiled(online.run, static_argnames="rounds")


@pytest.mark.parametrize(("history", "sets"), [(4, 4096), (16, 2048), (32, 1024), (160, 1024)])
def test_the_shorter_the_memory_the_more_sets_it_is_judged_by(history, sets):
    system = CartPole.create()
    make = lambda **sizes: online.Setup.create(system, Fixed(RandomPolicy(system.actions)), history=history, **sizes)  # noqa: E731
    assert make().calibrations == make(calibrations=0).calibrations == sets
    assert make(calibrations=7).calibrations == 7
    with pytest.raises(ValueError, match="calibrations is -1"):
        make(calibrations=-1)


def test_kept_sets_are_fitted_from_the_next_round_on_where_they_tell_of_recordings_in_use(small):
    given = []

    @struct.dataclass
    class Spy(MixtureDensity):
        """Notes what it is fitted to."""

        def fit(self, key, state, thetas, recordings, weights, draws=None):
            jax.debug.callback(lambda *seen: given.append(seen), thetas, recordings.observations, weights, draws)
            return super().fit(key, state, thetas, recordings, weights, draws)

    setup, target = small
    spy = Spy(**{field.name: getattr(TINY, field.name) for field in dataclasses.fields(TINY)})
    state, _ = jax.jit(online.run, static_argnames="rounds")(
        jax.random.key(3), setup.replace(estimator=spy), target, rounds=3
    )
    jax.effects_barrier()
    assert len(given) == 3
    for (thetas, seen, weights, draws), counts in zip(given, ((0, 0), (1, 0), (1, 2)), strict=True):
        assert len(thetas) == len(seen) == len(weights) == len(draws) == 2 * 64 + 2 * 5 * 4
        assert ((weights[128:] > 0).reshape(2, 5, 4).sum(-1) == np.array(counts)[:, None]).all()
        assert (draws[128:] == 128 + np.repeat(np.arange(10), 4)).all() and (draws[:128] == np.arange(128)).all()
    *_, (thetas, seen, _, _) = given
    kept = thetas[128:].reshape(2, 5, 4, -1)
    assert (kept == kept[:, :, :1]).all() and np.ptp(kept[:, :, 0], 1).min() > 0
    of_two = seen[128:].reshape(2, 5, 4, *seen.shape[-2:])[1, :, :2]
    assert not np.allclose(of_two[:, 0], of_two[:, 1])
    assert state.sets.filled.tolist() == [[True] * 3 + [False], [True] * 2 + [False] * 2]


def test_sets_of_a_machine_without_actuators_are_kept_too():
    unknown = Unknown("damping", ("joint/hinge/damping",), 0.0, 0.2, "N m s/rad")
    system = mjcf_system(SWINGING, [unknown])
    sizes = {"steps": 16, "simulations": 32, "pool": 2, "history": 4, "calibrations": 16, "kept": 5}
    setup = online.Setup.create(system, Fixed(RandomPolicy(system.actions)), estimator=TINY, **sizes)
    state = jax.eval_shape(lambda: online.init(jax.random.key(0), setup))
    recordings = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((1, *leaf.shape[1:]), leaf.dtype), state.history)
    assert recordings.actions.shape == (1, 16, 0)
    after, _ = jax.eval_shape(lambda s, r: online.update(jax.random.key(1), setup, s, r), state, recordings)
    assert jax.tree.map(jnp.shape, after) == jax.tree.map(jnp.shape, state)


def test_one_recording_beside_a_readout_of_sets_is_what_the_networks_say(small):
    setup, target = small
    state = start(jax.random.key(0), setup)
    seen = record(jax.random.key(1), setup, target, state)
    posterior = jax.jit(setup.estimator.posterior)
    moved = state.estimator.replace(correction=state.estimator.correction.replace(scale=jnp.array(3.0)))
    alone = [posterior(e, seen, jnp.ones(1, bool)) for e in (state.estimator, moved)]
    assert _same(*alone) and alone[0].log_weights.size == 2
    sets = [posterior(e, state.history, jnp.ones(4, bool)) for e in (state.estimator, moved)]
    assert jnp.allclose(sets[1].covariance(), 9.0 * sets[0].covariance(), rtol=1e-4)


def _same(a, b):
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(bool(jnp.array_equal(x, y, equal_nan=jnp.issubdtype(x.dtype, jnp.floating))) for x, y in leaves)


def _check_that_a_loop_changes_nothing(setup, target):
    key = jax.random.key(3)
    keys = online.split(key)
    first = start(keys.init, setup)
    whole, infos = run(key, setup, target, first, rounds=4)
    assert int(whole.round) == 4

    state = first
    for _ in range(4):
        state, _ = update(keys.update, setup, state, record(keys.record, setup, target, state))
    assert _same(whole, state)
    return key, first, whole, infos


def _check_that_chunks_change_nothing(setup, target, key, first, whole, infos):
    state, chunks = first, []
    for _ in range(2):
        state, info = run(key, setup, target, state, rounds=2)
        chunks.append(info)
    assert _same(whole, state)
    assert _same(infos, jax.tree.map(lambda a, b: jnp.concatenate([a, b]), *chunks))


def test_a_python_loop_is_the_whole_run_bit_for_bit(small):
    _check_that_a_loop_changes_nothing(*small)


@pytest.mark.slow
@pytest.mark.parametrize(("warmup", "inferences"), [(1, 2), (2, 0)])
def test_cuts_change_nothing_where_only_some_rounds_infer(cartpole, warmup, inferences):
    setup, target = cartpole
    setup, key = setup.replace(warmup=warmup, inferences=inferences), jax.random.key(3)
    keys = online.split(key)
    first = start(keys.init, setup)
    whole, infos = run(key, setup, target, first, rounds=4)
    inferred = jnp.array([warmup <= r < warmup + inferences for r in range(4)])
    assert (jnp.isfinite(infos.fit.log_q_validation) == inferred).all()
    assert (infos.recordings.valid.any((1, 2)) == inferred).all()
    prior = jax.tree.map(lambda leaf: leaf[0], infos.belief)
    assert _same(prior, first.belief)
    last = jax.tree.map(lambda leaf: leaf[-1], infos.belief)
    assert _same(last, whole.belief)
    assert _same(last, first.belief) == (inferences == 0)
    assert jnp.isfinite(infos.return_target).all()
    assert whole.pool.filled.sum() == min(inferences, 2)
    assert whole.sets.filled.sum() == (0, 1, 3)[inferences]
    _check_that_chunks_change_nothing(setup, target, key, first, whole, infos)

    state, improve = first, compiled(online.improve)
    for r in range(4):
        if online.infers(setup, r):
            state, _ = update(keys.update, setup, state, record(keys.record, setup, target, state))
        else:
            state, _ = improve(keys.update, setup, state)
    assert _same(whole.learner, state.learner)


@pytest.mark.slow
def test_chunks_and_a_python_loop_are_the_whole_run_at_the_paper_s_sizes():
    system, task = CartPole.create(), Balance(steps=500)
    setup = online.Setup.create(system, default_learner("cartpole", system, task), task)
    target = SimulatedTarget(system, task, jnp.array([0.5, 0.3]))
    _check_that_chunks_change_nothing(setup, target, *_check_that_a_loop_changes_nothing(setup, target))


def test_seeds_batch_and_a_new_truth_does_not_recompile(small):
    setup, target = small
    traces = []

    @jax.jit
    def several(keys, thetas):
        traces.append(None)
        return jax.vmap(lambda k, t: online.run(k, setup, target.replace(theta=t), rounds=2))(keys, thetas)

    keys = jax.random.split(jax.random.key(0), 3)
    state, infos = several(keys, jnp.array([[0.4], [0.2], [0.6]]))
    several(keys, jnp.array([[0.5], [0.3], [0.1]]))
    assert len(traces) == 1
    assert infos.fit.log_q_validation.shape == (3, 2)
    assert jnp.isfinite(state.belief.mixture.means).all()
    assert not _same(jax.tree.map(lambda x: x[0], state.belief), jax.tree.map(lambda x: x[1], state.belief))


def test_a_state_is_a_legal_carry(cartpole):
    setup, _ = cartpole
    state = jax.eval_shape(online.init, jax.random.key(0), setup)
    recordings = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((1, *leaf.shape[1:]), leaf.dtype), state.history)
    after, _ = jax.eval_shape(online.update, jax.random.key(0), setup, state, recordings)
    assert jax.tree.structure(state) == jax.tree.structure(after)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), state) == jax.tree.map(lambda x: (x.shape, x.dtype), after)


def test_diverged_simulations_are_counted_and_never_averaged_in(small):
    setup, target = small
    keys = online.split(jax.random.key(0))
    state, infos = start(keys.init, setup), []
    for _ in range(2):
        state, info = update(keys.update, setup, state, record(keys.record, setup, target, state))
        infos.append(info)
    assert 10 < int(infos[0].diverged) < 50  # a third of 64 to fit and of 16 sets of one recording each
    assert sum(int(info.fit.nonfinite) for info in infos) == 0
    assert jnp.isfinite(state.belief.log_prob(jnp.array([0.3])))
    assert jnp.isfinite(jnp.concatenate([x.ravel() for x in jax.tree.leaves(state.estimator)])).all()


def test_a_target_that_diverges_leaves_the_belief_alone(small):
    setup, target = small
    state = start(jax.random.key(0), setup)
    recordings = record(jax.random.key(1), setup, target.replace(theta=jnp.array([0.9])), state)
    assert bool(recordings.diverged.all())
    after, _ = update(jax.random.key(2), setup, state, recordings)
    assert _same(after.belief, state.belief)


def test_wrong_shapes_and_sizes_are_told_in_one_line(small):
    setup, _ = small
    with pytest.raises(ValueError, match="simulations is 0"):
        online.Setup.create(setup.system, setup.learner, simulations=0)
    state = start(jax.random.key(0), setup)
    recordings = jax.tree.map(lambda leaf: leaf[:3], state.history)
    with pytest.raises(ValueError, match=r"shape \(3, 12\)"):
        online.update(jax.random.key(0), setup, state, recordings)
    one = jax.tree.map(lambda leaf: leaf[:1], state.history)
    wide = one.replace(actions=jnp.zeros((1, 12, 2)))
    with pytest.raises(ValueError, match=r"actions of the recordings have shape \(1, 12, 2\).*asks for \(1, 12, 1\)"):
        online.update(jax.random.key(0), setup, state, wide)
    with pytest.raises(ValueError, match=r"history is 32, no multiple of recordings, 5.* take a history of 30"):
        online.Setup.create(setup.system, setup.learner, recordings=5)


def test_an_episode_that_diverges_is_not_averaged_in():
    """From a third of the resets on the count goes beyond what is a number; all others are paid 1 a step."""
    system = from_functions(
        parameters=Box.create(a=(0.0, 1.0, "")),
        observations=Box.create(count=(0.0, 100.0, "")),
        actions=Box.create(u=(-1.0, 1.0, "N")),
        noise=0.0,
        dt=0.1,
        reset=lambda key, theta: 9.0 * jax.random.bernoulli(key, 1 / 3, (1,)),
        step=lambda theta, x, u: jnp.where(x > 12, jnp.nan, x + 1),
    )
    task = Survive(steps=8)
    setup = online.Setup.create(system, Fixed(RandomPolicy(system.actions)), task, estimator=TINY, evaluations=16)
    target = SimulatedTarget(system, task, jnp.array([0.5]))
    state = SimpleNamespace(learner=(), round=jnp.array(0))
    told = online.evaluate(jax.random.key(0), setup, target, state)
    assert (float(told["return_target"]), float(told["cost_target"])) == (8.0, -1.0)
    assert jnp.isnan(told["success_target"])


def test_the_default_estimator_is_the_recurrent_mixture(cartpole):
    setup, _ = cartpole
    assert online.Setup.create(setup.system, setup.learner).estimator == recurrent_mixture()


def test_a_system_says_what_networks_read_of_it():
    system = SkidSteer.create()
    setup = online.Setup.create(system, Fixed(RandomPolicy(system.actions)), steps=7)
    assert setup.estimator == recurrent_mixture(features=SkidSteer.features) != recurrent_mixture()
    state = jax.eval_shape(lambda key: online.init(key, setup), jax.random.key(0))
    assert state.estimator.feature_mean.shape == (3,)


def test_a_wider_posterior_that_agrees_leaves_the_belief_and_one_that_disagrees_is_mixed_with_it(small):
    setup, target = small
    box = setup.system.parameters

    @jax.jit
    def belief(mean, sd):
        mixture = GaussianMixture(jnp.zeros(2), jnp.full((2, 1), mean), jnp.full((2, 1, 1), sd))
        return Truncated.create(mixture, box)

    @struct.dataclass
    class Given(TruncatedPrior):
        """A proposal mode whose posterior is given."""

        answer: Truncated | None = None

        def combine(self, belief, proposal, q):
            return self.answer

    known = belief(0.5, 0.02)
    state = start(jax.random.key(0), setup).replace(belief=known)
    recordings = record(jax.random.key(1), setup, target, state)
    quickly = jax.jit(online.update)
    for mean, sd, share in [(0.52, 0.05, 1.0), (0.8, 0.05, 2 / 3), (0.52, 0.01, 0.0), (0.8, 0.01, 0.0)]:
        given = setup.replace(proposal=Given(answer=belief(mean, sd)))
        after, info = quickly(jax.random.key(2), given, state, recordings)
        assert bool(info.uninformed) == (share == 1.0)
        for expected, whole in [(known, 1.0), (given.proposal.answer, 0.0)]:
            assert share != whole or _same(after.belief, expected)
        expected = (1 - share) * given.proposal.answer.mean() + share * known.mean()
        assert jnp.allclose(after.belief.mean(), expected, atol=1e-5)
    # a machine that may have changed is what the newest recordings say
    given = setup.replace(forget=0.1, proposal=Given(answer=belief(0.8, 0.05)))
    after, _ = quickly(jax.random.key(2), given, state, recordings)
    assert _same(after.belief, given.proposal.answer)


def test_recordings_that_are_replayed_are_those_of_the_truth():
    """Under recorded actions and the same start, the simulator at θ* shows what was recorded."""
    system, truth = CartPole.create(noise=0.0), jnp.array([0.4, 0.6])
    seen = rollout(jax.random.key(1), system, truth, RandomPolicy(system.actions), 16)
    again = rollout(jax.random.key(1), system, truth, RecordedActions(seen.actions), 16)
    assert _same(seen, again)
    other = rollout(jax.random.key(1), system, jnp.array([0.9, 0.2]), RecordedActions(seen.actions), 16)
    assert jnp.array_equal(other.actions, seen.actions)
    assert not jnp.allclose(other.observations, seen.observations)


@pytest.mark.slow
def test_a_planner_in_the_loop_is_simulated_with_its_actions_and_forgets():
    system, task = Pendulum.create(), Upswing(steps=30)
    planner = default_planner("disco", "pendulum", system, task, horizon=5, samples=8, particles=2)
    sizes = {"steps": 16, "simulations": 32, "pool": 2, "components": 2, "history": 4, "calibrations": 16}
    setup = online.Setup.create(system, planner, task, estimator=TINY, replay=True, forget=0.2, **sizes)
    target = SimulatedTarget(system, task, jnp.array([0.4, 0.6]))
    state, infos = jax.jit(online.run, static_argnames="rounds")(jax.random.key(0), setup, target, rounds=3)
    recorded = infos.recordings.actions[:, 0]
    assert jnp.array_equal(state.policies.actions[:3], recorded)
    simulated = state.pool.recordings.actions[2 % 2]
    matches = (simulated[:, 0, None] == recorded[None]).all((2, 3))
    assert matches.any(1).all()
    assert jnp.isfinite(infos.cost_target).all()
    assert jnp.allclose(infos.cost_target, -infos.return_target / 30, rtol=1e-5)


def test_a_contradicting_recording_no_longer_counts():
    class Reads:
        """The posterior of one recording is around its first observation."""

        def posterior(self, state, recordings, use):
            return GaussianMixture(jnp.zeros(1), recordings.observations[0, :1], 0.1 * jnp.eye(2)[None])

    means = jnp.array([[0.2, 0.2], [0.95, 0.2], [0.25, 0.3], [0.3, 0.2]])
    history = jax.tree.map(jnp.asarray, rollout(jax.random.key(0), Pendulum.create(), means[0], _still(), 1))
    history = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (4, *leaf.shape)), history)
    history = history.replace(observations=jnp.broadcast_to(means[:, None], (4, 2, 2)))
    setup = online.Setup.create(Pendulum.create(), Fixed(_still()), estimator=Reads(), forget=0.1)
    agree = online._agree(setup, None, history, jnp.array(3))
    assert agree.tolist() == [True, False, True, True]


def _still():
    return RandomPolicy(Pendulum.create().actions)


def test_a_loosened_belief_is_the_mixture_with_the_prior():
    box = Pendulum.create().parameters
    mixture = GaussianMixture(jnp.zeros(2), jnp.array([[0.2, 0.8], [0.4, 0.6]]), 0.05 * jnp.stack([jnp.eye(2)] * 2))
    loose = jax.jit(lambda mixture: Truncated.create(mixture, box).loosen(0.3))(mixture)
    draws = jax.jit(jax.vmap(loose.sample))(jax.random.split(jax.random.key(0), 20_000))
    assert jnp.allclose(loose.mean(), draws.mean(0), atol=0.01)
    assert jnp.allclose(loose.covariance(), jnp.cov(draws.T), atol=0.005)
